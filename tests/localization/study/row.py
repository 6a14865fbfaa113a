"""What a row of the study is given and what it gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from study.feeding import Flight, load_flight

from ground_station.localization.settings import LocalizerSettings
from ground_station.map.store import Map


@dataclass(frozen=True)
class Line:
    """One line of the table; `met` is None where there is no bound."""

    what: str
    bound: str
    figure: str
    met: bool | None
    seeds: str


@dataclass(frozen=True)
class Row:
    """A row of the table, in one or more lines, and everything measured for it."""

    lines: list[Line]
    data: dict[str, Any]


@dataclass
class Study:
    """What every row needs: map, settings, sizes, and flights kept in memory.

    `limit` is the most frames of a flight that are used, None for all.
    """

    map_: Map
    settings: LocalizerSettings
    flights: Sequence[str]
    others: Sequence[str]
    limit: int | None = None
    jumps: int = 200
    count: int = 1000
    seed: int = 0
    _kept: dict[str, Flight] = field(default_factory=dict)

    def flight(self, spec: str) -> Flight:
        """Decoded once, kept in memory."""
        if spec not in self._kept:
            self._kept[spec] = load_flight(spec, self.limit)
        return self._kept[spec]


def seeds(flights: Sequence[Flight]) -> str:
    return "; ".join(dict.fromkeys(flight.about for flight in flights))
