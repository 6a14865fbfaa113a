"""What stations tell each other beside what their buses say, and who may tell what."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from msgspec import Meta

from ground_station.service.alarms import Alarm
from ground_station.service.bus_messages import Message, RecordingMessage, WallTime
from ground_station.service.fleet.allocation import Pin
from pi_firmware.wire import credentials
from pi_firmware.wire.credentials import IN, OUT, SERVE

ROOT = "fleet"
PAYLOADS, ALARMS, WANTS, MAPS, RUNS = 64, 64, 16, 16, 32
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
class MapMessage(Message):
    """A map on a station's shelf: what it is made of, and in which coordinates.

    `id` is made of its content. `grown_from` are the ids of the maps that it was extended from, and
    how many landmarks each had; `landmarks` is how many it has.
    """

    name: Word
    id: Word
    coordinates: Word = ""
    landmarks: int = 0
    grown_from: Annotated[dict[Word, int], Meta(max_length=RUNS)] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StationMessage(Message):
    """How a station is, twice a second.

    `map_id` is made of its map's content, `load` is the share of its processors that it uses,
    `overloaded` that they are too slow for its payloads. `wants` are those that are looked at,
    `hears` all that are heard, `pins` where a person wants some to fly. `maps` are those that it
    gives: its own first, then what grew on its shelf.
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
    maps: Annotated[list[MapMessage], Meta(max_length=MAPS)] = field(default_factory=list)


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
