"""Asks a payload to do something, and brings its answer."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping

from pi_firmware.wire import keys, messages
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import Session

NAMES = ("record-start", "record-stop", "idr", "bitrate", "exposure", "shutdown", "reboot")
_NAME = re.compile(r"[a-z][a-z0-9-]{0,31}")
_POLL_S = 0.05


def ask(
    session: Session,
    payload_id: str,
    name: str,
    arguments: Mapping[str, float] | None = None,
    timeout_s: float = 5.0,
) -> messages.Answer:
    """Sends one command, once, and waits for its answer, which may be a refusal with its reason.

    It waits up to `timeout_s` for the payload to be there, and as long again for the answer. Raises
    `TelemetryError` with one line when nobody answers, and says whether the command was sent: one
    that was may have been carried out all the same.
    """
    if not _NAME.fullmatch(name):
        raise TelemetryError(f"command {name[:40]!r}: expected a name as {NAMES[2]!r}")
    key = keys.command(payload_id, name)
    command = messages.Command(time_ns=time.time_ns(), arguments=dict(arguments or {}))
    body = messages.encode(command)
    _wait_for_payload(session, payload_id, key, timeout_s)
    asked = f"payload {payload_id!r} was asked for {name!r}"
    sent_s = time.monotonic()
    for reply in session.zenoh.get(key, payload=body, timeout=timeout_s):
        if reply.ok is not None:
            return messages.decode(messages.Answer, reply.ok.payload.to_bytes())
    if time.monotonic() - sent_s >= timeout_s:
        raise TelemetryError(f"{asked} and did not answer within {timeout_s:g} s")
    raise TelemetryError(f"{asked} and gave no answer: it ended, or its link did")


def _wait_for_payload(session: Session, payload_id: str, key: str, timeout_s: float) -> None:
    """Until somebody takes questions at the key; raises `TelemetryError` when nobody does in time.

    A question that reaches nobody would end at once: a session needs a moment to find its peers.
    """
    querier = session.zenoh.declare_querier(key)
    try:
        deadline_s = time.monotonic() + timeout_s
        while not querier.matching_status.matching:
            if time.monotonic() > deadline_s:
                raise TelemetryError(_absent(session, payload_id, timeout_s))
            time.sleep(_POLL_S)
    finally:
        querier.undeclare()


def _absent(session: Session, payload_id: str, timeout_s: float) -> str:
    alive = keys.key(payload_id, keys.ALIVE)
    if any(reply.ok for reply in session.zenoh.liveliness().get(alive, timeout=1.0)):
        return f"payload {payload_id!r} is alive but takes no commands: its program is an older one"
    return (
        f"payload {payload_id!r} was not heard of within {timeout_s:g} s:"
        " it is off, out of reach, or does not list this ground station"
    )
