"""What the intake is asked: its own recording, and commands to payloads."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from ground_station.errors import InputError
from ground_station.service.intake.recording import GroundRecorder
from ground_station.stream import commands
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.telemetry import Session

_ANSWER_S = 2.0
"""For the payload to be found, and again for its answer: who asks waits for 5 s."""
_AFTER = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}/[A-Za-z0-9][A-Za-z0-9_.:+-]{0,127}\.mcap")


def answer(
    request: Mapping[str, Any], recorder: GroundRecorder, session: Session
) -> dict[str, Any]:
    """Does what is asked; raises a `BlimpError` with one line when it cannot be done."""
    what = request.get("do")
    if what == "record-start":
        after = request.get("after", "")
        if not isinstance(after, str) or (after and not _AFTER.fullmatch(after)):
            raise InputError(f"'after' is {str(after)[:40]!r}; allowed: STATION/FILE.mcap")
        return {"file": recorder.start(after)}
    if what == "record-stop":
        return {"file": recorder.stop()}
    if what == "payload-command":
        return _command(request, session)
    raise InputError(
        f"'do' is {str(what)[:40]!r}; allowed: record-start, record-stop, payload-command"
    )


def _command(request: Mapping[str, Any], session: Session) -> dict[str, Any]:
    payload_id, name = request.get("payload"), request.get("name")
    arguments = request.get("arguments") or {}
    if not isinstance(payload_id, str) or name not in commands.NAMES:
        raise InputError(f"command {str(name)[:40]!r}; allowed: {', '.join(commands.NAMES)}")
    check_payload_id(payload_id)
    if not isinstance(arguments, dict) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        for value in arguments.values()
    ):
        raise InputError(f"command {name!r}: its arguments must be finite numbers by name")
    numbers = {str(key): float(value) for key, value in arguments.items()}
    answered = commands.ask(session, payload_id, name, numbers, _ANSWER_S)
    return {"done": answered.done, "reason": answered.reason, "values": dict(answered.values)}
