"""How old a map is: what flights should have seen of it and did not."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.geometry.lens import Lens
from ground_station.localization.projection import project
from ground_station.localization.settings import ProjectionSettings
from ground_station.localization.visibility import LandmarkIndex
from ground_station.map.store import Map

_CONES = ProjectionSettings(viewing_cone=True, cone_margin_deg=5.0, max_distance_ratio=1.2)
"""Places from which a keyframe saw a landmark, or nearly: from elsewhere something may hide it."""


def never_seen(map_: Map, wTc: F64, seen: I64, often: int) -> dict[str, int]:
    """How many landmarks were `often` in view of cameras (K, 4, 4), and how many of these not seen.

    `seen` are those that were. They are counted and not removed: another light hides, too.
    """
    lens, index = Lens(map_.info.camera), LandmarkIndex(map_.landmarks)
    times = np.zeros(len(map_.landmarks), np.int64)
    for T in wTc:
        times[project(map_.landmarks, T, lens, _CONES, index.near(T, lens, _CONES)).landmark] += 1
    expected = times >= often
    missed = expected.copy()
    missed[seen] = False
    return {"expected": int(expected.sum()), "never_seen": int(missed.sum())}
