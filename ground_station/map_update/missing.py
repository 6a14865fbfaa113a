"""Where landmarks should have been seen by flights and never were: furniture was moved.

A flight uses a few hundred landmarks at a time, and light, blur and what stands before them hide
others, so that one that is not seen says little. Those of a place that are nearly all missing,
where elsewhere one of seven or eight is, say that the place is another, or that something stands
before it; or, where the light is not the map's, that it is lit otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from ground_station.arrays import F64, I64
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import ProjectionSettings
from ground_station.localization.visibility import LandmarkIndex, project
from ground_station.map.observations import FlightObservations
from ground_station.map.store import Map
from ground_station.mapping.construction.placing.chains import components

_CONES = ProjectionSettings(viewing_cone=True, cone_margin_deg=5.0, max_distance_ratio=1.2)
"""Places from which a keyframe saw a landmark, or nearly: from elsewhere something may hide it."""

_APART_S = 0.25
"""Frames nearer in time show the same."""

_CELL = 0.08
"""Side of a cell, of the depth at which the map's landmarks are seen: 0.75 m in a hall."""

_FAR = 2.0
"""Of that depth: landmarks that no keyframe saw from nearer are small, and seldom followed."""

_MISSING = 0.75
"""Of a place's landmarks: so many are never seen where it is another."""

_BY_CHANCE = 0.01
"""The probability that chance alone makes one place or more of a flight look like another."""


@dataclass(frozen=True)
class Area:
    """A place: its middle (3,) and its size (3,), metres, the landmarks that were often in view of
    the flights there, and how many of these were never seen."""

    middle_m: F64
    size_m: F64
    expected: int
    missing: int


def times_in_view(map_: Map, wTc: Iterable[F64], camera: Camera) -> I64:
    """How many of the cameras (K, 4, 4) should see each landmark (M,): from where keyframes did."""
    index, times = LandmarkIndex(map_.landmarks), np.zeros(len(map_.landmarks), np.int64)
    for T in wTc:
        near = index.near(T, camera, _CONES)
        times[project(map_.landmarks, T, camera, _CONES, near).landmark] += 1
    return times


def missing_areas(map_: Map, flights: Sequence[FlightObservations], often: int) -> list[Area]:
    """Places whose landmarks were `often` in view of the flights and are missing, most first.

    Its constants were chosen on two flights through one simulated hall. Lengths are in the map's
    own units where it is not registered.
    """
    landmarks = map_.landmarks
    times, seen = np.zeros(len(landmarks), np.int64), np.zeros(len(landmarks), bool)
    for flight in flights:
        step = np.floor((flight.time_ns - flight.time_ns[:1]) / (_APART_S * 1e9))
        apart = np.flatnonzero(np.diff(step, prepend=-1) > 0)
        times += times_in_view(map_, flight.wTc[apart], flight.camera)
        seen |= np.isin(landmarks.id, flight.landmark)
    if not len(landmarks):
        return []
    # What fewer keyframes found than half of the landmarks were found in, few frames will find.
    fair = landmarks.observations >= np.median(landmarks.observations)
    fair &= (landmarks.distance_m[:, 0] <= _FAR * map_.depth_m) & (times >= often)
    position, missed = landmarks.position_m[fair], ~seen[fair]
    if not len(position):
        return []
    cell = np.floor(position / (_CELL * map_.depth_m)).astype(np.int64)
    cell, place = np.unique(cell, axis=0, return_inverse=True)
    place = place.ravel()
    expected, missing = (np.bincount(place, x, len(cell)) for x in (np.ones(len(place)), missed))
    chance = stats.binom.sf(missing - 1, expected, missed.mean())
    other = (chance * len(cell) < _BY_CHANCE) & (missing >= _MISSING * expected)
    part = np.full(len(cell), -1)
    touching = cKDTree(cell[other]).query_pairs(1.0, p=np.inf, output_type="ndarray")
    part[other] = components([touching], int(other.sum()))
    areas = []
    for number in range(part.max(initial=-1) + 1):
        at = part[place] == number
        low, high = position[at].min(axis=0), position[at].max(axis=0)
        count = int(missed[at].sum())
        areas.append(Area((low + high) / 2, high - low, int(at.sum()), count))
    return sorted(areas, key=lambda area: -area.missing)
