"""`pi_firmware.commands`: what the ground may ask for, and with which numbers."""

from __future__ import annotations

import threading
from queue import Queue

from pieces import Picker, as_json, changed, refusing

from pi_firmware.commands import Action, Commands
from pi_firmware.wire import messages
from pi_firmware.wire.errors import TelemetryError

_NAMES = ("bitrate", "exposure", "idr", "", "bitrate ", "x" * 300)


def fuzz(data: bytes) -> None:
    """What is carried out had its numbers in their ranges, and every answer can be sent."""
    picker, seen = Picker(data), []
    commands = Commands.__new__(Commands)
    commands._actions = {
        "bitrate": Action(
            lambda kbps: seen.append(kbps), {"kbps": (64, 8000)}, frozenset({"kbps"})
        ),
        "exposure": Action(lambda **numbers: numbers, {"exposure_s": (0, 1), "gain": (0, 16)}),
        "idr": Action(lambda: None),
    }
    commands._waiting, commands._closing = Queue(8), threading.Event()
    while picker.left():
        name = picker.of(_NAMES)
        given = {"kbps": picker.real()} if picker.number(1) % 2 else {"gain": 1, "exposure_s": 0.5}
        document = {"schema": "blimp.command/1.0", "time_ns": 1, "arguments": given}
        with refusing(TelemetryError):
            command = messages.decode(messages.Command, as_json(changed(picker, document)))
            answer = commands.carry_out(name, command)
            messages.encode(answer)
            assert len(answer.reason.splitlines()) <= 1
    assert all(64 <= kbps <= 8000 for kbps in seen)


def seeds() -> list[bytes]:
    """One of each."""
    return [b"\0\1" + bytes(7) + b"\x40" + bytes(4), b"\1\0" + bytes(5), b"\2\0\0\0\0\xff"]
