"""What a row of the study is given and what it gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from study.feeding import Feed, Flight, Run, close, feed, load_flight, make_localizer

from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map.store import Map
from ground_station.recording.frames import Frame


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
    """What every row needs: map, settings, the way of feeding, sizes, and flights kept in memory.

    `limit` is the most frames of a flight that are used, None for all.
    """

    map_: Map
    settings: LocalizerSettings
    demo: str
    fast: Sequence[str]
    flights: Sequence[str]
    others: Sequence[str]
    feed: Feed = feed
    limit: int | None = None
    jumps: int = 200
    repetitions: int = 10
    count: int = 1000
    seed: int = 0
    flown: dict[str, Run] = field(default_factory=dict)
    _kept: dict[str, Flight] = field(default_factory=dict)

    def flight(self, spec: str) -> Flight:
        """Decoded once, kept in memory."""
        if spec not in self._kept:
            self._kept[spec] = load_flight(spec, self.limit)
        return self._kept[spec]

    def localizer(self, flight: Flight, settings: LocalizerSettings | None = None) -> Localizer:
        return make_localizer(self.map_, flight.camera, settings or self.settings)

    def fly(self, spec: str) -> Run:
        """A whole flight by the default settings without a first pose; flown once, for all rows."""
        if spec not in self.flown:
            flight = self.flight(spec)
            localizer = self.localizer(flight)
            try:
                self.flown[spec] = self.feed(localizer, flight.frames)
            finally:
                close(localizer)
        return self.flown[spec]


def start_from_truth(localizer: Localizer, flight: Flight, frames: Sequence[Frame]) -> None:
    """Gives a localizer the true pose of the first of some frames of a flight."""
    localizer.set_initial_pose(flight.true_wTc(frames[:1])[0], frames[0].time_ns)


def thesis() -> LocalizerSettings:
    return load_preset("thesis")


def ungated(settings: LocalizerSettings) -> LocalizerSettings:
    """The same without a least entropy: a start of gated frames is the end without recovery."""
    return replace(settings, gate=replace(settings.gate, min_entropy_bits=0.0))


def seeds(flights: Sequence[Flight]) -> str:
    return "; ".join(dict.fromkeys(flight.about for flight in flights))
