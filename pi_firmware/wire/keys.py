"""The Zenoh keys of a payload: `blimp/<payload_id>/<kind>`."""

from __future__ import annotations

import re

from pi_firmware.wire.errors import TelemetryError

ROOT = "blimp"
BATTERY, HEALTH, GATE, EVENT, POSE = "battery", "health", "gate", "event", "pose"
COMMAND, ALIVE, AUTOPILOT = "command", "alive", "autopilot"
CLOCK, TIME = "clock", "time"  # the payload answers the one, the ground station the other
LINK = "link"  # the ground station's report of the video

_PAYLOAD_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")


def check_payload_id(payload_id: str) -> str:
    """Returns the id; raises `TelemetryError` when it could not be one chunk of a key."""
    if not _PAYLOAD_ID.fullmatch(payload_id):
        raise TelemetryError(
            f"payload_id {payload_id!r:.60}: allowed are 1 to 32 of a-z, 0-9, - and _, "
            "starting with a letter or digit"
        )
    return payload_id


def key(payload_id: str, kind: str) -> str:
    """The key of one kind of message of one payload, as `blimp/blimp-1/battery`."""
    return f"{ROOT}/{check_payload_id(payload_id)}/{kind}"


def command(payload_id: str, name: str) -> str:
    """The key at which a payload answers a command, as `blimp/blimp-1/command/idr`."""
    return f"{key(payload_id, COMMAND)}/{name}"


def every_payload(kind: str) -> str:
    """The key expression that matches one kind of message of every payload."""
    return f"{ROOT}/*/{kind}"


def payload_of(key_expression: str) -> str | None:
    """The payload's id in a received key; None when the key is not one of ours."""
    parts = key_expression.split("/")
    if len(parts) < 3 or parts[0] != ROOT or not _PAYLOAD_ID.fullmatch(parts[1]):
        return None
    return parts[1]
