"""`ground_station.service.bus_messages`, and what the web process keeps and shows of them."""

from __future__ import annotations

import dataclasses
import json

from pieces import Picker, as_json, changed, refusing, stretch

from ground_station.service import bus_messages
from ground_station.service.settings import Run
from ground_station.service.web.metrics import Metrics
from ground_station.service.web.snapshot import Snapshot
from pi_firmware.wire import messages

_EXAMPLES = (
    bus_messages.FrameMessage(0, 2, 1, 2, 3, 4, 640, 480, 7),
    bus_messages.EstimateMessage(
        1, 2, 3, 4, "TRACKING", 5, "", [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0], [0.1] * 36, [0.1] * 9,
        points_px=[1.0, 2.0], stage_ms={"pose": 2.0},
    ),
    bus_messages.PayloadMessage(
        True, 1, 7, frames={"captured": 3}, stream={"packets": 4}, clock={"offset_ns": 5},
        battery=messages.Battery(1, 3.9), health=messages.Health(1, 60.0), autopilot=None,
    ),
    bus_messages.EventMessage(1, "station", bus_messages.INFO, "hello", "a text"),
    bus_messages.RecordingMessage(True, "flight-1.mcap"),
    bus_messages.ProcessMessage("intake", 100),
)  # fmt: skip


def fuzz(data: bytes) -> None:
    """Whatever a note says, the state stays a document of JSON's and the metrics a text."""
    picker = Picker(data)
    snapshot = Snapshot(Run(), "1", lambda: 10**9)
    metrics = Metrics(snapshot)
    takes = (
        snapshot.frame,
        snapshot.estimate,
        snapshot.payload,
        snapshot.event,
        snapshot.recording,
        snapshot.process,
    )
    while picker.left():
        number = picker.number(1) % len(_EXAMPLES)
        example = _EXAMPLES[number]
        if picker.number(1) % 8 == 7:
            text = picker.rest()
        else:
            text = as_json(changed(picker, dataclasses.asdict(example)))
        with refusing(bus_messages.MessageError):
            note = bus_messages.decode(type(example), text)
            takes[number]("blimp-1", note)
            if number == 1:
                metrics.estimate("blimp-1", note)
    json.dumps(snapshot.document(), allow_nan=False)
    metrics.text()


def seeds() -> list[bytes]:
    """One of each kind, and all of them."""
    one = [bytes([number, 0]) + bytes(32) for number in range(len(_EXAMPLES))]
    deep = [stretch((1, b"\3\7"), (n, b"["), (n, b"]")) for n in (900, 980, 50_000)]
    inside = b'\2\7{"alive":true,"seen_ns":1,"battery":{"a":'
    nested = [stretch((1, inside), (n, b"["), (n, b"]"), (1, b"}}")) for n in (300, 900, 970)]
    return [*one, b"".join(one), *deep, *nested]
