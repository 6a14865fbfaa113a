"""`ground_station.stream.telemetry`: what a listener keeps of payloads that say anything."""

from __future__ import annotations

import dataclasses
import threading

from pieces import Picker

from ground_station.stream import telemetry
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.wire import messages
from readers.messages import KINDS, text

_NAMES = ("battery", "gate", "event", "pose", "autopilot", "health", "link", "alive", "command/x")


_LETTERS_A_MESSAGE = 2 << 20
"""Of two lists of 64 texts of 1024 letters, each of them written with ten."""


@dataclasses.dataclass
class _Sample:
    key_expr: str
    payload: _Sample | None = None
    data: bytes = b""

    def to_bytes(self) -> bytes:
        return self.data


def fuzz(data: bytes) -> None:
    """A hundred messages of a few payloads; what is kept stays bounded and readable."""
    picker = Picker(data)
    listener = TelemetryListener.__new__(TelemetryListener)
    listener._states, listener._changed = {}, threading.Condition()
    listener._on_message = lambda *_: None
    taken = 0
    while taken < 100:
        if not picker.left():
            break
        name = picker.of(_NAMES)
        payload = f"blimp-{picker.number(1)}" if picker.number(1) < 250 else picker.bytes(8).hex()
        message = text(picker, picker.of(KINDS) if name == "battery" else _of(name))
        taken += 1
        listener._take(_Sample(f"blimp/{payload}/{name}", _Sample("", data=message)))
    assert len(listener.payloads()) <= telemetry._KEPT_PAYLOADS
    for payload in listener.payloads():
        state = listener.state(payload)
        assert state is not None
        _ = state.frames, state.ssrc
        assert len(repr(state)) < _LETTERS_A_MESSAGE * (1 + taken)


def _of(name: str) -> messages.Message:
    return next((kind for kind in KINDS if f"blimp.{name}" == kind.SCHEMA), KINDS[2])


def seeds() -> list[bytes]:
    """A flight's beginning, of two payloads."""
    return [
        bytes([1, 1, 0, 0]) + bytes(16) + bytes([2, 1, 0, 0]) + bytes(8),
        bytes([2, 1, 0, 0]) + bytes(8) + bytes([1, 2, 0, 0]) + bytes(16),
    ]
