"""Chosen landmarks cover every view, and the parts of its picture, with the better ones."""

from __future__ import annotations

import numpy as np
import pytest
from rooms_map import looking, made_of, wall

from ground_station.experiments import thinning
from ground_station.experiments.viewpoints import CELLS, ExpectedObservations, expected_observations
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.inspection.visibility import View


def _random_observations(
    seed: int, views=10, landmarks=60
) -> tuple[ExpectedObservations, np.ndarray]:
    rng = np.random.default_rng(seed)
    view, landmark = np.nonzero(rng.random((views, landmarks)) < 0.3)
    cells = CELLS[0] * CELLS[1]
    observations = ExpectedObservations(
        view,
        view * cells + rng.integers(0, 10, len(view)),
        landmark,
        rng.uniform(0.2, 1.0, len(view)),
        rng.uniform(0.3, 1.0, views),
    )
    return observations, rng.uniform(0.2, 1.0, landmarks)


def _utility(observations: ExpectedObservations, quality: np.ndarray, kept: np.ndarray) -> float:
    """What `cover` says it makes less, written down once more: how much less it is made."""
    total = 0.0
    for v, weight in enumerate(observations.weight):
        mine = np.flatnonzero((observations.view == v) & np.isin(observations.landmark, kept))
        covered = 0.0
        for cell in np.unique(observations.cell[mine]):
            here = mine[observations.cell[mine] == cell]
            shown = (quality[observations.landmark[here]] * observations.chance[here]).sum()
            covered += np.sqrt(1 + shown) - 1
        total += weight * (1 - 1 / (1 + covered))
    return total


def _greedy(observations: ExpectedObservations, quality: np.ndarray, count: int) -> list[int]:
    """One after the other, by the utility itself."""
    kept: list[int] = []
    for _ in range(count):
        left = [m for m in range(len(quality)) if m not in kept]
        kept.append(max(left, key=lambda m: _utility(observations, quality, np.array([*kept, m]))))
    return kept


def test_rounds_cover_as_well_as_one_by_one():
    observations, quality = _random_observations(3)
    ours = thinning.cover(observations, quality, 15, rounds=5)
    assert len(set(ours.tolist())) == 15
    best = _utility(observations, quality, np.array(_greedy(observations, quality, 15)))
    rng = np.random.default_rng(0)
    chance = [_utility(observations, quality, rng.permutation(60)[:15]) for _ in range(20)]
    found = _utility(observations, quality, ours)
    assert found > 0.97 * best
    assert found > max(chance)


def test_a_part_of_the_picture_is_not_filled_before_others_have_something():
    """Ten landmarks in one cell, one in each of three others, all as good."""
    cell = np.array([0] * 10 + [1, 2, 3])
    observations = ExpectedObservations(
        np.zeros(13, int), cell, np.arange(13), np.ones(13), np.ones(1)
    )
    kept = thinning.cover(observations, np.ones(13), 4)
    assert set(cell[kept]) == {0, 1, 2, 3}


def test_what_nobody_sees_comes_last():
    observations = ExpectedObservations(
        np.zeros(3, int), np.zeros(3, int), np.arange(3), np.ones(3), np.ones(1)
    )
    quality = np.array([0.1, 0.1, 0.1, 1.0, 0.9])
    assert set(thinning.cover(observations, quality, 3)) == {0, 1, 2}
    assert set(thinning.cover(observations, quality, 4)) == {0, 1, 2, 3}


def test_a_view_that_sees_little_keeps_more_of_it():
    """A hundred landmarks before ten keyframes, and eight more before one that looks elsewhere."""
    rng = np.random.default_rng(8)
    position = np.concatenate([wall(rng, 6.0, 100), wall(rng, 6.0, 8) * [-1, 1, 1]])
    wTc = [looking([x, 3.0, 1.5], 0.0) for x in np.linspace(0.2, 2.0, 10)]
    wTc.append(looking([1.0, 3.0, 1.5], 180.0))
    view = View(THESIS_CAMERA)
    seen = [np.flatnonzero(view.inside(poses.transform(poses.inverse(T), position))) for T in wTc]
    assert 3 <= len(seen[-1]) <= 8
    map_ = made_of(position, np.array(wTc), seen)
    weight = expected_observations(map_).weight[: len(wTc)]
    assert weight[-1] == 1 and weight[:-1].sum() == pytest.approx(1, abs=0.1)
    kept = thinning.choose(map_, 30)
    share = [np.isin(s, kept).mean() for s in seen]
    assert share[-1] > 1.5 * max(share[:-1])


def test_quality_is_less_where_a_landmark_is_known_worse_or_varied_more(rooms):
    lm = rooms.landmarks
    before = thinning.quality(lm, 500.0)
    assert (before > 0).all()
    distance = np.sqrt(lm.distance_m.prod(axis=1))
    assert np.corrcoef(1 / distance, before)[0, 1] > 0.99  # all else is the same
    lm.spread[3] *= 4
    ray = lm.view_direction[7].astype(float)
    aside = np.cross(ray, [0, 0, 1.0])
    lm.covariance_m2[7] += (0.05**2 * np.outer(aside, aside)).astype(np.float32)
    lm.covariance_m2[9] += (0.05**2 * np.outer(lm.view_direction[9], lm.view_direction[9])).astype(
        np.float32
    )
    after = thinning.quality(lm, 500.0)
    assert after[3] < 0.8 * before[3] and after[7] < 0.5 * before[7]
    assert after[9] == pytest.approx(before[9], rel=0.02)  # along the ray it hardly matters
    assert np.array_equal(np.delete(after, [3, 7, 9]), np.delete(before, [3, 7, 9]))


def test_a_subset_of_all_is_all(rooms):
    same = thinning.subset(rooms, np.arange(len(rooms.landmarks)))
    for name in ("id", "position_m", "spread", "descriptor"):
        assert np.array_equal(getattr(same.landmarks, name), getattr(rooms.landmarks, name))
    for name in ("offset", "landmark", "pixel_px"):
        assert np.array_equal(getattr(same.keyframes, name), getattr(rooms.keyframes, name))


def test_a_subset_keeps_the_observations_of_its_landmarks(rooms):
    kept = thinning.choose(rooms, 100)
    some, kf = thinning.subset(rooms, kept), rooms.keyframes
    assert np.array_equal(some.landmarks.id, rooms.landmarks.id[kept])
    for k in range(len(kf)):
        seen = kf.landmark[kf.offset[k] : kf.offset[k + 1]]
        row = slice(some.keyframes.offset[k], some.keyframes.offset[k + 1])
        assert np.array_equal(kept[some.keyframes.landmark[row]], seen[np.isin(seen, kept)])


def test_as_many_are_chosen_as_asked_for_in_order(rooms):
    kept = thinning.choose(rooms, 100)
    assert len(kept) == 100 and (np.diff(kept) > 0).all()
    assert np.array_equal(kept, thinning.choose(rooms, 100))
    assert np.array_equal(thinning.choose(rooms, 10**6), np.arange(len(rooms.landmarks)))


def test_keyframes_and_views_beside_them_show_what_they_and_their_neighbours_saw(rooms):
    kf, cells = rooms.keyframes, CELLS[0] * CELLS[1]
    # Of the first keyframe's landmarks, one that the others of its room never found again.
    rare = int(kf.landmark[kf.offset[0]])
    left = (kf.landmark != rare) | (np.arange(len(kf.landmark)) < kf.offset[1])
    kf.offset = np.concatenate([[0], np.cumsum(left)])[kf.offset]
    kf.landmark, kf.pixel_px = kf.landmark[left], kf.pixel_px[left]
    observations = expected_observations(rooms)
    own = observations.view < len(kf)
    for k in range(len(kf)):
        shown = observations.landmark[observations.view == k]
        assert np.isin(kf.landmark[kf.offset[k] : kf.offset[k + 1]], shown).all()
    assert ((observations.chance > 0) & (observations.chance < 1)).all()
    first = observations.view == 0
    assert observations.chance[first & (observations.landmark == rare)] < 0.3
    assert np.median(observations.chance[first]) > 0.7
    assert (observations.cell // cells == observations.view).all()
    assert ((observations.weight > 0) & (observations.weight <= 1)).all()
    assert 4 * len(kf) <= len(observations.weight) - len(kf) <= 5 * len(kf)
    # The middle of the picture is the cell of row 3 (of 6), column 4 (of 8).
    middle = np.flatnonzero((np.abs(kf.pixel_px - [350, 270]) < 12).all(axis=1))
    image = np.searchsorted(kf.offset, middle, side="right") - 1
    assert len(middle)
    for k, m in zip(image.tolist(), kf.landmark[middle].tolist(), strict=True):
        (there,) = observations.cell[own & (observations.view == k) & (observations.landmark == m)]
        assert there == k * cells + 3 * CELLS[0] + 4


def test_the_other_room_is_not_expected_through_the_wall(rooms):
    """Its landmarks project into the pictures, but who looks from here never saw them."""
    observations, half = expected_observations(rooms), len(rooms.landmarks) // 2
    room_of_keyframe = np.repeat([0, 1], len(rooms.keyframes) // 2)
    seen = {v: set() for v in range(len(observations.weight))}
    for v, m in zip(observations.view.tolist(), observations.landmark.tolist(), strict=True):
        seen[v].add(m >= half)
    assert all(len(rooms_seen) == 1 for rooms_seen in seen.values() if rooms_seen)
    own = [seen[k] == {bool(room)} for k, room in enumerate(room_of_keyframe)]
    assert all(own)
