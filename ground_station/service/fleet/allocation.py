"""Which payloads a station leaves to others: by load, with hysteresis, and where a person says so.

A payload flies with a station that reports to it, and on with another when that falls silent. So a
station that leaves a payload says nothing to it for a while; nobody else has to agree, and one that
is wrong about the others gets it back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

ARRIVAL_S, ARRIVAL_APART = 5.0, 0.1
"""One that comes goes to the station with less load, if that differs by so much, within so long."""
OVERLOADED_S, MOVE_APART = 10.0, 0.25
"""One that flies here goes when this computer has been too slow for so long and another is not."""
MOVE_S, REST_S = 10.0, 60.0
"""It has so long to be taken there; after a move all rest for so long."""
_PINS = 64


@dataclass(frozen=True)
class Peer:
    """Another station: the share of its processors that it uses, and the payloads that it hears."""

    load: float
    overloaded: bool
    hears: frozenset[str]


@dataclass(frozen=True)
class Pin:
    """Where a person wants a payload to fly, and since when; "": by load."""

    station: str
    time_ns: int


class Allocation:
    """One station's; not safe from several threads."""

    def __init__(self, own: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._own, self._clock = own, clock
        self.pins: dict[str, Pin] = {}
        self._alone_s: dict[str, float] = {}
        self._overloaded_s: float | None = None
        self._moving: tuple[str, float, str] | None = None
        self._rests_until_s = float("-inf")

    def pin(self, payload_id: str, pin: Pin) -> None:
        """Takes a person's word, said here or told by another station; the newest one holds."""
        before = self.pins.get(payload_id)
        known = before is not None or len(self.pins) < _PINS
        if known and (before is None or before.time_ns < pin.time_ns):
            self.pins[payload_id] = pin

    def leaves(
        self,
        here: Iterable[str],
        alone: Iterable[str],
        load: float,
        overloaded: bool,
        others: Mapping[str, Peer],
    ) -> dict[str, str]:
        """The payloads to say nothing to now, and why, in words.

        `here` are those that fly here, `alone` those that are heard and fly with nobody yet.
        """
        now_s, here, alone = self._clock(), sorted(here), set(alone)
        self._alone_s = {name: self._alone_s.get(name, now_s) for name in alone}
        result = {}
        for name in (*here, *alone):
            if name in alone and now_s - self._alone_s[name] >= ARRIVAL_S:
                continue  # nobody took it, or its address for video is fixed
            wanted = self.pins[name].station if name in self.pins else ""
            if wanted and wanted in others and name in others[wanted].hears:
                result[name] = f"station '{wanted}' was chosen for it"
            elif not wanted and name in alone:
                better = _best(name, load - ARRIVAL_APART, others)
                if better:
                    result[name] = f"station '{better}' has less to do"
        result.update(self._moved(here, load, overloaded, others, now_s))
        return result

    def _moved(
        self,
        here: list[str],
        load: float,
        overloaded: bool,
        others: Mapping[str, Peer],
        now_s: float,
    ) -> dict[str, str]:
        if not overloaded:
            self._overloaded_s = None
        elif self._overloaded_s is None:
            self._overloaded_s = now_s
        if self._moving is not None:
            name, since_s, why = self._moving
            if name in here and now_s - since_s < MOVE_S:
                return {name: why}
            self._moving, self._rests_until_s = None, now_s + REST_S
        slow = self._overloaded_s is not None and now_s - self._overloaded_s >= OVERLOADED_S
        if slow and now_s >= self._rests_until_s:
            for name in reversed(here):
                if name in self.pins and self.pins[name].station:
                    continue
                if better := _best(name, load - MOVE_APART, others):
                    why = f"this computer is too slow, station '{better}' is not"
                    self._moving = name, now_s, why
                    return {name: why}
        return {}


def _best(payload_id: str, limit: float, others: Mapping[str, Peer]) -> str:
    """The station with the least load below a limit that hears a payload and is quick enough."""
    free = [
        (peer.load, name)
        for name, peer in others.items()
        if payload_id in peer.hears and not peer.overloaded and peer.load <= limit
    ]
    return min(free)[1] if free else ""
