"""Which features of a frame are landmarks of the map, looked for around the frame's pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ground_station.arrays import F64, Indices
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.matching import Matcher, describe
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.store import Map
from ground_station.map_update.extension.frames import Frames
from ground_station.map_update.extension.localizing import LocatedFlight

_RADIUS_PX = 8.0
"""A landmark is looked for so near to where a localized frame's pose projects it."""
_ALL = 10_000


class Anchoring:
    """The localizer's own matching, of all of a frame's features."""

    def __init__(
        self,
        map_: Map,
        flights: Sequence[LocatedFlight],
        frames: Frames,
        settings: LocalizerSettings,
    ) -> None:
        settings = replace(settings, pose=replace(settings.pose, max_observations=_ALL))
        self._matchers = [
            Matcher(map_, flight.camera, settings, flight.distance_scale) for flight in flights
        ]
        self._frames = frames

    def of(self, k: int, wTc: F64, twist: F64) -> tuple[Indices, Indices]:
        """Features (N,) of frame k at wTc (4, 4) with a twist (6,), and their landmarks (N,)."""
        frames = self._frames
        matcher = self._matchers[int(frames.flight[k])]
        seen = describe(frames.features[k], matcher.camera, Conditions())
        expected = Kinematics(int(frames.time_ns[k]), wTc, twist, np.zeros((12, 12)))
        matches = matcher.match(seen, expected, _RADIUS_PX, Stopwatch())
        return matches.feature, matches.landmark
