"""A model is held against the rotations of its own pairs, and against weak bridges."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.geometry.epipolar import essential
from ground_station.mapping.construction.placing import bridges, contradictions
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.sfm.two_view import TwoView

K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
PINHOLE = np.array([500.0, 500, 320, 240])


def scene(seed: int = 0, count: int = 12, points: int = 160, half=(1.5, 1.5, 1.5)):
    """A camera that goes round a box of points: poses (n, 4, 4), points (M, 3), pixels.

    `half` (3,) is half the box's size, metres.
    """
    rng = np.random.default_rng(seed)
    world = rng.uniform(-1, 1, (points, 3)) * half
    wTc = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(np.linspace(0, 0.9, count)):
        z = -np.array([np.sin(angle), 0, -np.cos(angle)])
        x = np.cross([0.0, 1, 0], z)
        wTc[k, :3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        wTc[k, :3, 3] = -5 * z + [0, 0.2 * np.sin(9 * angle), 0]
    return wTc, world, [_seen(pose, world) + rng.normal(0, 0.2, (points, 2)) for pose in wTc]


def _seen(wTc, world):
    local = poses.transform(poses.inverse(wTc), world)
    return local[:, :2] / local[:, 2:] * PINHOLE[:2] + PINHOLE[2:]


def _pairs(wTc, matches):
    result = {}
    for i in range(len(wTc)):
        for j in range(i + 1, min(i + 5, len(wTc))):
            result[i, j] = TwoView(matches, essential(wTc[i], wTc[j]), None, False)
    return result


def _placed(wTc, world, pixels) -> Placed:
    every = np.arange(len(world))
    return Placed([every] * len(wTc), dict(enumerate(wTc)), world, PINHOLE, pixels)


def told(**options):
    wTc, world, pixels = scene(**options)
    every = np.arange(len(world), dtype=np.int32)
    pairs = _pairs(wTc, np.stack([every, every], axis=1))
    return wTc, world, pixels, pairs, contradictions.rotations(pairs, pixels, K)


def test_rotations_of_a_right_model_are_confirmed_and_denied_by_nobody():
    wTc, world, pixels, pairs, found = told()
    assert found.keys() == pairs.keys()
    for (i, j), R in found.items():
        here = poses.inverse(wTc[j])[:3, :3] @ wTc[i][:3, :3]
        assert np.degrees(poses.rotation_angle(R @ here.T)) < 1
    groups = contradictions.consistent_groups(_placed(wTc, world, pixels), found, pairs)
    assert groups == [set(range(len(wTc)))]


def test_images_that_fit_where_their_pairs_deny_them_are_groups_of_their_own():
    """As in a model that is folded: what is seen is shallow, and all of it nearly fits."""
    wTc, world, pixels, pairs, found = told(half=(0.7, 0.7, 0.1))
    further = poses.exp(np.array([0, -np.radians(9), 0, 0, 0, 0]))
    turned = np.concatenate([wTc[:8], further @ wTc[8:]])
    model = _placed(turned, world, pixels)
    good, total = np.sum([model.in_place(pair, view) for pair, view in pairs.items()], axis=0)
    assert good > 0.9 * total
    groups = contradictions.consistent_groups(model, found, pairs)
    assert groups == [set(range(8)), set(range(8, 12))]


def test_a_rotation_that_is_off_denies_nothing_that_fits_its_matches_as_well():
    """A few matches, of a plane or at a distance, hardly tell a turn from a step."""
    wTc, world, pixels, pairs, found = told()
    off = poses.exp(np.array([0, np.radians(12), 0, 0, 0, 0]))[:3, :3]
    wrong = {(i, j): off @ R if i < 6 <= j else R for (i, j), R in found.items()}
    groups = contradictions.consistent_groups(_placed(wTc, world, pixels), wrong, pairs)
    assert groups == [set(range(len(wTc)))]


def test_a_pair_that_no_third_image_confirms_speaks_against_nobody():
    _, _, pixels, pairs, _ = told()
    lone = {pair: view for pair, view in pairs.items() if pair[1] - pair[0] == 1}
    assert contradictions.rotations(lone, pixels, K) == {}
    flat = {pair: TwoView(view.matches, view.essential, None, True) for pair, view in pairs.items()}
    assert contradictions.rotations(flat, pixels, K) == {}


@pytest.mark.parametrize(
    ("shared", "noise_px", "sets"),
    [(60, 0.5, [10]), (12, 0.5, [10]), (12, 5.0, [10]), (12, 50.0, [5, 5]), (0, 0.5, [5, 5])],
)
def test_a_bridge_of_few_landmarks_carries_as_much_as_noise_leaves(
    monkeypatch, shared, noise_px, sets
):
    monkeypatch.setattr(bridges, "_NOISE_PX", noise_px)
    wTc, world, _ = scene(count=10, points=200)
    landmark = []
    for k in range(10):
        of = np.full(len(world), -1)
        rows = np.arange(0, 70) if k < 5 else np.arange(70, 140)
        of[rows] = rows
        of[140 : 140 + shared] = np.arange(140, 140 + shared)
        landmark.append(of)
    model = Placed(landmark, dict(enumerate(wTc)), world, PINHOLE)
    assert [len(each) for each in bridges.separated(model)] == sets
    said = bridges.doubt(bridges.hinges(model), [f"frame-{k}" for k in range(10)])
    if (shared, noise_px) == (12, 5.0):
        assert len(said) == 1 and "5 images, frame-0 to frame-4, hang on the rest" in said[0]
        assert "off by 2.9%" in said[0]
    else:
        assert said == []


def test_an_image_alone_hangs_by_its_pose():
    wTc, world, _ = scene(count=6, points=80)
    landmark = [np.arange(80)] * 5 + [np.where(np.arange(80) < 12, np.arange(80), -1)]
    model = Placed(landmark, dict(enumerate(wTc)), world, PINHOLE)
    assert bridges.separated(model) == [set(range(6))]


def test_two_images_that_stand_among_the_others_landmarks_carry_their_scale(monkeypatch):
    """As where a walk comes back: two of its images see what those of before have."""

    def sets(guests: int, hosts: int = 0, seed: int = 0) -> list[int]:
        wTc, world, _ = scene(seed, count=10, points=200)
        landmark = []
        for k in range(10):
            of = np.full(len(world), -1)
            rows = np.arange(0, 100) if k < 5 else np.arange(100, 200)
            of[rows] = rows
            landmark.append(of)
        # Each guest sees landmarks of its own among the others', so that no two share one.
        for k in range(guests):
            rows = np.arange(40 * k, 40 * (k + 1))
            landmark[5 + k][rows] = rows
        for k in range(hosts):
            rows = np.arange(100 + 40 * k, 100 + 40 * (k + 1))
            landmark[k][rows] = rows
        model = Placed(landmark, dict(enumerate(wTc)), world, PINHOLE)
        return [len(each) for each in bridges.separated(model)]

    # About one image the others' scale is open, whatever rounding makes of an eigenvalue of 0.
    assert [sets(1, seed=seed) for seed in range(8)] == [[5, 5]] * 8
    assert sets(2) == [10]
    assert sets(1, 1) == [10]  # one each way: the step between these two has both lengths
    monkeypatch.setattr(bridges, "_NOISE_PX", 50.0)  # which it has too loosely then
    assert sets(1, 1) == [5, 5]
    assert sets(2) == [10]
