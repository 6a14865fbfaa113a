"""What stations tell each other beside what their buses say, and who may tell what."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from ground_station.map.folder import FLOWN_IN
from ground_station.service.alarms import Alarm
from ground_station.service.bus_messages import Message, RecordingMessage, WallTime
from ground_station.service.fleet.allocation import Pin
from pi_firmware.wire import credentials
from pi_firmware.wire.credentials import IN, OUT, SERVE

ROOT = "fleet"
PAYLOADS, ALARMS, WANTS = 64, 64, 16
"""Of one station's message, at most."""
MESSAGE_BYTES = 512 * 1024
SESSION = {
    "scouting/gossip/enabled": True,  # who joins one finds the others through it
    "transport/link/rx/max_message_size": MESSAGE_BYTES,
}
"""Of Zenoh's settings, those between stations."""

WORD = 128
Word = Annotated[str, Meta(max_length=WORD)]


@dataclass(frozen=True, slots=True)
class StationMessage(Message):
    """How a station is, twice a second.

    `map_id` is made of its map's content, `load` is the share of its processors that it uses,
    `overloaded` that they are too slow for its payloads. `wants` are those that are looked at,
    `hears` all that are heard, `pins` where a person wants some to fly.
    """

    time_ns: WallTime
    version: Word
    map: Word
    map_id: Word
    load: float = 0.0
    overloaded: bool = False
    recording: RecordingMessage | None = None
    alarms: Annotated[list[Alarm], Meta(max_length=ALARMS)] = field(default_factory=list)
    wants: Annotated[list[Word], Meta(max_length=WANTS)] = field(default_factory=list)
    hears: Annotated[list[Word], Meta(max_length=PAYLOADS)] = field(default_factory=list)
    pins: Annotated[dict[Word, Pin], Meta(max_length=PAYLOADS)] = field(default_factory=dict)


def map_files(folder: Path) -> list[Path]:
    """The files of a map that localizers and pages read."""
    return [folder / name for name in FLOWN_IN if (folder / name).is_file()]


def map_id(folder: Path) -> str:
    """Tells a map from another of the same name: its files' names and sizes, its `map.toml`."""
    found = hashlib.sha256()
    with contextlib.suppress(OSError):
        for path in map_files(folder):
            found.update(f"{path.name} {path.stat().st_size}\n".encode())
        found.update((folder / "map.toml").read_bytes())
    return found.hexdigest()[:16]


def rules(held: credentials.Credentials) -> dict[str, Any]:
    """Zenoh's `access_control` between stations: each speaks under its own name only."""
    result = credentials.Rules()
    ours, every = [f"{ROOT}/{held.member}/**"], [f"{ROOT}/*/**"]
    for station in held.stations:
        theirs = [f"{ROOT}/{station.partition('.')[2]}/**"]
        result.allow(
            station,
            [
                ("told", OUT, ["put", *SERVE], ours),
                ("tells", IN, ["put", *SERVE], theirs),
                ("heard", OUT + IN, ["declare_subscriber"], every),
                ("asks", OUT, ["query"], theirs),
                ("asked", IN, ["query"], ours),
            ],
        )
    return result.document()
