"""A map with fewer landmarks keeps what its keyframes saw of those that are left."""

from __future__ import annotations

import numpy as np

from ground_station.experiments.disturbances.landmarks import Fewer, subset


def test_a_subset_of_all_is_all(rooms):
    same = subset(rooms, np.arange(len(rooms.landmarks)))
    for name in ("id", "position_m", "spread", "descriptor"):
        assert np.array_equal(getattr(same.landmarks, name), getattr(rooms.landmarks, name))
    for name in ("offset", "landmark", "pixel_px"):
        assert np.array_equal(getattr(same.keyframes, name), getattr(rooms.keyframes, name))


def test_a_subset_keeps_the_observations_of_its_landmarks(rooms):
    kept = np.arange(3, 303, 3)
    some, kf = subset(rooms, kept), rooms.keyframes
    assert np.array_equal(some.landmarks.id, rooms.landmarks.id[kept])
    for k in range(len(kf)):
        seen = kf.landmark[kf.offset[k] : kf.offset[k + 1]]
        row = slice(some.keyframes.offset[k], some.keyframes.offset[k + 1])
        assert np.array_equal(kept[some.keyframes.landmark[row]], seen[np.isin(seen, kept)])


def test_a_share_is_drawn_by_its_seed_and_holds_the_smaller_ones(rooms):
    total = len(rooms.landmarks)
    half, quarter, again, other = (
        Fewer(share).map(rooms, seed).landmarks.id
        for share, seed in ((0.5, 1), (0.25, 1), (0.5, 1), (0.5, 2))
    )
    assert (len(half), len(quarter)) == (round(total / 2), round(total / 4))
    assert np.array_equal(half, again) and not np.array_equal(half, other)
    assert np.isin(quarter, half).all()
