"""Which payloads fly with which station, by what this one's bus and the others say."""

from __future__ import annotations

import dataclasses
import threading
import time
from dataclasses import dataclass
from typing import Any

from ground_station.service import bus_messages
from ground_station.service.alarms import EVERYWHERE
from ground_station.service.bus_messages import EstimateMessage, PayloadMessage
from ground_station.service.fleet.messages import PAYLOADS, WORD, MapMessage, StationMessage

FRESH_S = 3.0
"""Older than this a station's word says nothing of now."""
_KEPT_S = 600.0
_STATIONS = 32
_MOVED_S = 30.0
"""A payload that came from another station no longer ago than this goes on being recorded."""


@dataclass(frozen=True)
class _Other:
    said: StationMessage
    came_s: float
    clock_s: float
    """Its clock less ours, and what the message took."""

    def is_fresh(self, now_s: float) -> bool:
        return now_s - self.came_s < FRESH_S


class Whereabouts:
    """One station's view of the payloads here and elsewhere. Safe from any thread.

    `maps` are this station's, its own first: poses elsewhere are told in coordinates.
    """

    def __init__(self, maps: list[MapMessage]) -> None:
        self.maps = maps
        self._lock = threading.Lock()
        self._here: dict[str, tuple[float, PayloadMessage]] = {}
        self._away: dict[str, tuple[str, float]] = {}
        self._twins: dict[str, tuple[str, float]] = {}
        self._others: dict[str, _Other] = {}

    # What is heard

    def here(self, payload_id: str, note: PayloadMessage) -> str:
        """This station's bus tells of a payload.

        STATION/FILE that it was recorded in until it came here; "" for none.
        """
        now_s = time.monotonic()
        with self._lock:
            self._here[payload_id] = (now_s, note)
            if note.rate_hz <= 0 or not self._flies_here(payload_id, now_s):
                return ""
            station, at_s = self._away.pop(payload_id, ("", 0.0))
            other = self._others.get(station)
        if other is None or now_s - at_s > _MOVED_S:
            return ""
        recording = other.said.recording
        return f"{station}/{recording.file}" if recording and recording.active else ""

    def takes_up(self, station: str, payload_id: str, note: PayloadMessage) -> bool:
        """Whether a payload is another station's; one that flies here, too, is two of one name."""
        now_s = time.monotonic()
        with self._lock:
            if self._flies_here(payload_id, now_s):
                own = self._here[payload_id][1]
                if own.rate_hz > 0 and note.rate_hz > 0 and own.ssrc != note.ssrc:
                    self._twins[payload_id] = (station, now_s)
                return False
            before, at_s = self._away.get(payload_id, (station, now_s))
            if before != station and now_s - at_s < FRESH_S and note.rate_hz <= 0:
                return False  # it has just gone from there
            if payload_id not in self._away and len(self._away) >= PAYLOADS:
                self._away = {n: one for n, one in self._away.items() if self._flown(n, now_s)}
                if len(self._away) >= PAYLOADS:
                    return False
            self._away[payload_id] = (station, now_s)
        return True

    def heard(self, station: str, said: StationMessage) -> bool:
        """Another station's word; whether it counts."""
        clock_s = 1e-9 * (said.time_ns - time.time_ns())
        with self._lock:
            known = station in self._others or len(self._others) < _STATIONS
            if known:
                self._others[station] = _Other(said, time.monotonic(), clock_s)
        return known

    def forget(self) -> None:
        """Stations that have not been heard for long."""
        now_s = time.monotonic()
        with self._lock:
            self._others = {n: o for n, o in self._others.items() if now_s - o.came_s <= _KEPT_S}

    # What is so now

    def station_of(self, payload_id: str) -> str:
        """The station that a payload flies with, as that one says; "" for here or nowhere."""
        with self._lock:
            return self._flown(payload_id, time.monotonic())

    def heard_here(self) -> tuple[set[str], dict[str, PayloadMessage]]:
        """The payloads that are heard here, and of those that fly here what is told of them."""
        now_s = time.monotonic()
        with self._lock:
            heard = {
                n for n, (at_s, note) in self._here.items() if now_s - at_s < FRESH_S and note.alive
            }
            return heard, {n: self._here[n][1] for n in heard if self._flies_here(n, now_s)}

    def fresh(self) -> dict[str, StationMessage]:
        """The words of the stations that are heard now."""
        now_s = time.monotonic()
        with self._lock:
            return {n: o.said for n, o in self._others.items() if o.is_fresh(now_s)}

    def knows(self, station: str) -> bool:
        """Whether a station flies beside this one."""
        with self._lock:
            return station in self._others

    def wanted(self) -> frozenset[str]:
        """The payloads here that are looked at elsewhere."""
        wants = {name for said in self.fresh().values() for name in said.wants}
        now_s = time.monotonic()
        with self._lock:
            return frozenset(name for name in wants if self._flies_here(name, now_s))

    def in_our_map(self, station: str, note: EstimateMessage) -> bool:
        """Whether a pose is in this station's coordinates, whatever its map is called there."""
        with self._lock:
            other = self._others.get(station)
        if other is None:
            return False
        if note.coordinates:
            return note.coordinates == self.maps[0].coordinates
        return self._is_ours(other.said) and note.map[:WORD] in ("", other.said.map)

    # For people

    def document(self) -> dict[str, Any]:
        """The other stations, what of theirs could be fetched, and names that fly twice."""
        now_s = time.monotonic()
        with self._lock:
            flown = {name: self._flown(name, now_s) for name in self._away}
            return {
                "stations": [
                    {
                        "name": name,
                        "version": other.said.version,
                        "map": other.said.map,
                        "same_map": self._is_ours(other.said),
                        "load": other.said.load,
                        "age_s": round(now_s - other.came_s, 1),
                        "clock_s": round(other.clock_s, 2),
                        "recording": bool(other.said.recording and other.said.recording.active),
                        "payloads": sorted(one for one, where in flown.items() if where == name),
                    }
                    for name, other in sorted(self._others.items())
                ],
                "offers": self._offers(now_s),
                "twins": {
                    name: station
                    for name, (station, at_s) in self._twins.items()
                    if now_s - at_s < FRESH_S
                },
            }

    def alarms(self) -> list[dict[str, Any]]:
        """The alarms of the other stations and of the payloads that fly with them.

        Those that this station finds by itself as well are left out.
        """
        return [
            {
                **dataclasses.asdict(alarm),
                "id": f"{name}/{alarm.id}",
                "text": f"{alarm.text} (station '{name}')",
            }
            for name, said in sorted(self.fresh().items())
            for alarm in said.alarms
            if not alarm.id.startswith(EVERYWHERE)
            if alarm.payload == bus_messages.STATION or self.station_of(alarm.payload) == name
        ]

    def _offers(self, now_s: float) -> list[dict[str, Any]]:
        """Maps of others that grew from this station's, and that it has not yet."""
        own, held = self.maps[0], {one.id for one in self.maps}
        return [
            {"station": name, "map": one.name, "more": one.landmarks - one.grown_from[own.id]}
            for name, other in sorted(self._others.items())
            if other.is_fresh(now_s)
            for one in other.said.maps
            if own.id in one.grown_from
            and one.coordinates == own.coordinates
            and one.id not in held
        ]

    def _flies_here(self, payload_id: str, now_s: float) -> bool:
        """Call it with the lock held."""
        came_s, note = self._here.get(payload_id, (float("-inf"), None))
        return note is not None and now_s - came_s < FRESH_S and note.alive and not note.station

    def _flown(self, payload_id: str, now_s: float) -> str:
        """Call it with the lock held."""
        station, at_s = self._away.get(payload_id, ("", float("-inf")))
        here = self._flies_here(payload_id, now_s)
        return station if now_s - at_s < FRESH_S and not here else ""

    def _is_ours(self, said: StationMessage) -> bool:
        """Whether another station's map has the coordinates of this one's; an older one tells the
        content of its map alone."""
        own = self.maps[0]
        if said.maps and said.maps[0].coordinates:
            return said.maps[0].coordinates == own.coordinates
        return said.map_id == own.id
