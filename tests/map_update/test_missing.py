"""Places whose landmarks flights should have seen and never did."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.geometry.camera import Camera
from ground_station.map import store
from ground_station.map.observations import FlightObservations
from ground_station.map_update.missing import missing_areas

CAMERA = Camera(640, 480, 320.0, 320.0, 319.5, 239.5)
COUNT = 1500


@pytest.fixture
def map_() -> store.Map:
    """A wall 5 m before keyframes, found by eight of them."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform([-2, -1.5], [2, 1.5], (COUNT, 2)), np.full(COUNT, 5.0)])
    ones = np.ones(COUNT, np.float32)
    lm = store.Landmarks(
        id=np.arange(COUNT) * 3 + 7,
        position_m=points,
        covariance_m2=np.zeros((COUNT, 3, 3), np.float32),
        descriptor=np.ones((COUNT, 4), np.float32),
        spread=0 * ones,
        view_direction=np.tile(np.array([0, 0, -1], np.float32), (COUNT, 1)),
        view_cos=0.8 * ones,
        distance_m=np.tile(np.array([4.5, 5.5], np.float32), (COUNT, 1)),
        observations=np.full(COUNT, 8, np.int32),
    )
    none = np.empty(0, np.int64)
    keyframes = store.Keyframes([], none, np.empty((0, 4, 4)), np.zeros(1, np.int64), none,
                                np.empty((0, 2), np.float32))  # fmt: skip
    return store.Map(store.MapInfo("wall", "c" * 64, 4, CAMERA), lm, keyframes)


def flown(map_: store.Map, seen: np.ndarray, apart_s: float = 0.3) -> FlightObservations:
    """Twelve frames before the wall; the first saw what was seen at all."""
    wTc = np.tile(np.eye(4), (12, 1, 1))
    wTc[:, 0, 3] = np.linspace(-0.2, 0.2, 12)
    ids = map_.landmarks.id[seen]
    offset = np.array([0, *[len(ids)] * 12])
    pixel_px = np.zeros((len(ids), 2), np.float32)
    times = np.round(np.arange(12) * apart_s * 1e9).astype(np.int64)
    return FlightObservations("f", "wall", "", CAMERA, times, wTc, offset, ids, pixel_px)


def by_chance(map_: store.Map) -> np.ndarray:
    return np.random.default_rng(6).random(len(map_.landmarks)) > 0.15


def test_landmarks_that_are_missing_together_are_a_place(map_):
    seen = by_chance(map_)
    assert missing_areas(map_, [flown(map_, seen)], 10) == []
    gone = (np.abs(map_.landmarks.position_m[:, :2] - [0.8, 0.4]) < 0.4).all(axis=1)
    (area,) = missing_areas(map_, [flown(map_, seen & ~gone)], 10)
    assert np.abs(area.middle_m - [0.8, 0.4, 5.0]).max() < 0.1
    assert 0.4 <= area.size_m[0] <= 0.8 and area.missing >= 0.5 * gone.sum()
    assert 0.75 * area.expected <= area.missing <= area.expected


def test_what_another_flight_saw_is_not_missing(map_):
    seen = by_chance(map_)
    gone = (np.abs(map_.landmarks.position_m[:, :2] - [0.8, 0.4]) < 0.4).all(axis=1)
    flights = [flown(map_, seen & ~gone), flown(map_, gone)]
    assert missing_areas(map_, flights, 10) == []


def test_a_moment_says_nothing_of_what_is_missing(map_):
    nothing = np.zeros(len(map_.landmarks), bool)
    assert missing_areas(map_, [flown(map_, nothing, apart_s=0.01)], 10) == []
    assert missing_areas(map_, [], 10) == []
