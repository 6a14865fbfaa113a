"""What `map.toml` says of refinements: which flights are in the map, and what it was before."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_station.arrays import I64
from ground_station.errors import MapError
from ground_station.map.store import Map

FRAME_TIME = "frame"
"""`pixels_at` of a map whose observations are where a global shutter would have seen them."""


@dataclass(frozen=True)
class Refined:
    """The table `refined`: empty for a map as it was built.

    The keyframes that were added come after those that were built, in the order of `flights`, each
    a table with its `name` and number of `frames`. `landmarks_sha256` are hashes that the map's
    landmarks had before some of them were dropped: observations of those are still observations of
    this map. `last` is the report of the last refinement."""

    runs: int = 0
    pixels_at: str = ""
    flights: list[dict[str, Any]] = field(default_factory=list)
    landmarks_sha256: list[str] = field(default_factory=list)
    last: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, map_: Map) -> Refined:
        """That of a map; raises `MapError` when it is not what this program writes."""
        table = map_.info.refined
        found = cls(
            table.get("runs", 0),
            table.get("pixels_at", ""),
            table.get("flights", []),
            table.get("landmarks_sha256", []),
            table.get("last", {}),
        )
        fits = isinstance(found.runs, int) and found.pixels_at in ("", FRAME_TIME)
        fits &= isinstance(found.landmarks_sha256, list) and isinstance(found.last, dict)
        fits &= isinstance(found.flights, list) and all(_is_flight(f) for f in found.flights)
        if not fits or sum(f["frames"] for f in found.flights) > len(map_.keyframes):
            raise MapError(f"{map_.folder}: the table 'refined' in its map.toml cannot be read")
        return found

    def groups(self, keyframes: int) -> I64:
        """The group of each keyframe (K,): 0 for those that were built, then 1, 2, … by flight."""
        sizes = [flight["frames"] for flight in self.flights]
        sizes = [keyframes - sum(sizes), *sizes]
        return np.repeat(np.arange(len(sizes)), sizes)

    def as_dict(self) -> dict[str, Any]:
        """The table."""
        return dict(vars(self))


def _is_flight(table: Any) -> bool:
    frames = table.get("frames") if isinstance(table, dict) else None
    named = isinstance(table, dict) and isinstance(table.get("name"), str)
    return named and isinstance(frames, int) and not isinstance(frames, bool) and frames >= 0
