"""Messages are checked as they are decoded: who takes one may trust its types and ranges."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    MessageError,
    PayloadMessage,
)
from ground_station.service.pictures import damaged_in, packed
from pi_firmware.wire import messages

FRAME = FrameMessage(0, 2, 1, 10, 20, 30, 64, 48, 5, exposure_s=0.01)
ESTIMATE = EstimateMessage(1, 2, 3, 4, "TRACKING", 5, "", [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])
PAYLOAD = PayloadMessage(True, 1, battery=messages.Battery(1, 3.9), health=messages.Health(2, 60.0))


@pytest.mark.parametrize(
    "message", [FRAME, ESTIMATE, PAYLOAD, EventMessage(1, "a", "info", "b", "c")]
)
def test_a_message_comes_back_as_it_was(message: bus_messages.Message) -> None:
    assert bus_messages.decode(type(message), bus_messages.encode(message)) == message
    assert json.loads(bus_messages.encode(message)) == bus_messages.as_document(message)


@pytest.mark.parametrize(
    ("message", "name", "value"),
    [
        (FRAME, "slot", -1), (FRAME, "slot", "0"), (FRAME, "slot", 0.5), (FRAME, "slot", True),
        (FRAME, "stamp", None), (FRAME, "time_ns", float("nan")), (FRAME, "time_ns", 1 << 63),
        (FRAME, "time_ns", [1]), (FRAME, "clock_ns", -5), (FRAME, "sequence", {}),
        (FRAME, "width_px", 1 << 70), (FRAME, "capture_ns", "now"), (FRAME, "capture_ns", 1 << 62),
        (FRAME, "exposure_s", "0.01"), (FRAME, "gain", float("inf")),
        (ESTIMATE, "state", "FINE"), (ESTIMATE, "position_m", [1.0, 2.0]),
        (ESTIMATE, "position_m", 3), (ESTIMATE, "position_m", ["a", 1.0, 2.0]),
        (ESTIMATE, "position_m", [1.0, 2.0, float("nan")]), (ESTIMATE, "covariance", [1.0] * 35),
        (ESTIMATE, "quaternion_xyzw", "xyzw"), (ESTIMATE, "done_ns", 1 << 62),
        (PAYLOAD, "battery", {"time_ns": 1}), (PAYLOAD, "frames", {"sent": "many"}),
        (PAYLOAD, "alive", 1),
    ],
)  # fmt: skip
def test_what_cannot_be_is_no_message(message: bus_messages.Message, name: str, value: Any) -> None:
    text = json.dumps(bus_messages.as_document(message) | {name: value}).encode()
    with pytest.raises(MessageError, match=type(message).__name__):
        bus_messages.decode(type(message), text)


_AT_ONCE = """
import sys, threading
from dataclasses import make_dataclass
from ground_station.service.bus_messages import decode

sys.setswitchinterval(1e-6)
for n in range(20):
    parts = [make_dataclass(f"Part{n}_{k}", [("x", float, 0.0)]) for k in range(20)]
    kind = make_dataclass(f"Kind{n}", [(f"f{k}", one | None, None) for k, one in enumerate(parts)])
    gate = threading.Barrier(8)

    def hear():
        gate.wait()
        decode(kind, b'{"f19": {"x": 1.0}, "f3": {"x": 2.0}}')

    threads = [threading.Thread(target=hear) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
"""


def test_threads_may_hear_their_first_message_of_a_kind_at_once() -> None:
    ended = subprocess.run([sys.executable, "-c", _AT_ONCE], timeout=120, check=False)
    assert ended.returncode == 0


@pytest.mark.parametrize("depth", [40, 900, 100_000])
@pytest.mark.parametrize(("begin", "end"), [("[", "]"), ('{"a":', "}"), ("[1,", "]")])
def test_one_that_nests_without_end_is_none(depth: int, begin: str, end: str) -> None:
    nested = begin * depth + "1" + end * depth
    with pytest.raises(MessageError, match="PayloadMessage"):
        bus_messages.decode(
            PayloadMessage, f'{{"alive": true, "seen_ns": 1, "battery": {nested}}}'.encode()
        )


@pytest.mark.parametrize("text", [b"", b"{}", b"\xff\x00", b"[1]", b'{"\\u000c\\n\\u0000": 1}'])
def test_a_refusal_is_one_line_whatever_the_bytes_are(text: bytes) -> None:
    with pytest.raises(MessageError) as refused:
        bus_messages.decode(bus_messages.ProcessMessage, text)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(("height", "width"), [(480, 640), (470, 650)])
def test_damage_crosses_the_bus_as_bits(height: int, width: int) -> None:
    rows, columns = -(-height // 16), -(-width // 16)
    damaged = np.random.default_rng(3).random((rows, columns)) < 0.3
    frame = FrameMessage(0, 2, 7, 1_000, 2_000, 3_000, width, height, 1, damaged=packed(damaged))
    again = damaged_in(bus_messages.decode(FrameMessage, bus_messages.encode(frame)))
    assert again is not None and np.array_equal(again, damaged)
    assert damaged_in(replace(frame, damaged=packed(None))) is None
    short = damaged_in(replace(frame, damaged=b"\xff"))
    assert short is not None and short.shape == (rows, columns)
