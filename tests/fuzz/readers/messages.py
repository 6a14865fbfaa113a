"""`pi_firmware.wire.messages`: what came over Zenoh, of each kind."""

from __future__ import annotations

import dataclasses

from pieces import Picker, as_json, changed, refusing, stretch

from pi_firmware.wire import messages
from pi_firmware.wire.errors import TelemetryError

KINDS = (
    messages.Battery(1, 3.9),
    messages.Gate(1, 2, 3, True, False, 7.0, 100.0, 4, 1, 0, 3, 7),
    messages.Event(1, "started", "it started", {"captured": 1}),
    messages.Pose(1, 2, 3, "TRACKING", [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0], [0.01] * 36),
    messages.Autopilot(1, True),
    messages.Health(1, 2.0, throttled=["undervoltage"]),
    messages.LinkReport(1, "station", 5600, 7),
    messages.Command(1, {"kbps": 800.0}),
    messages.Answer(1, True, "", {"kbps": 800.0}),
)


def text(picker: Picker, example: messages.Message) -> bytes:
    """A message's text: bytes as they are, or the example with some values exchanged."""
    if picker.number(1) % 4 == 3:
        return picker.rest()
    schema = f"{example.SCHEMA}/{example.MAJOR}.{example.MINOR}"
    return as_json(changed(picker, {"schema": schema, **dataclasses.asdict(example)}))


def fuzz(data: bytes) -> None:
    """What is taken can be sent on, and says the same."""
    picker = Picker(data)
    example = picker.of(KINDS)
    with refusing(TelemetryError):
        taken = messages.decode(type(example), text(picker, example))
        assert messages.decode(type(example), messages.encode(taken)) == taken


def seeds() -> list[bytes]:
    """One of each kind, and nests as deep as JSON's parser follows."""
    found = [bytes([number, 0]) for number in range(len(KINDS))]
    found += [bytes([n, 3]) + messages.encode(example) for n, example in enumerate(KINDS)]
    for depth in (300, 950, 980, 990, 5000):
        head = b'\2\3{"schema":"blimp.event/1.0","time_ns":1,"name":'
        found.append(stretch((1, head), (depth, b"["), (depth, b"]"), (1, b"}")))
        found.append(stretch((1, b'\2\3{"schema":'), (depth, b"["), (depth, b"]"), (1, b"}")))
    head = b'\7\3{"schema":"blimp.command/1.0","time_ns":'
    return [*found, stretch((1, head), (20_000, b"9"), (1, b"}"))]
