"""A model is held against the rotations of its own pairs, and against weak bridges."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.mapping.construction.matching import TwoView
from ground_station.mapping.construction.placing import bridges, contradictions
from ground_station.mapping.construction.placing.placed import Placed

K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
PINHOLE = np.array([500.0, 500, 320, 240])


def scene(seed: int = 0, count: int = 12, points: int = 160):
    """A camera that goes round a cloud of points: poses (n, 4, 4), points (M, 3), pixels."""
    rng = np.random.default_rng(seed)
    world = rng.uniform(-1.5, 1.5, (points, 3))
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
            T = poses.inverse(wTc[j]) @ wTc[i]
            x, y, z = T[:3, 3]
            across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            result[i, j] = TwoView(matches, across @ T[:3, :3], None, False)
    return result


def _placed(wTc, world) -> Placed:
    every = np.arange(len(world))
    return Placed([every] * len(wTc), dict(enumerate(wTc)), world, PINHOLE)


@pytest.fixture
def told():
    wTc, world, pixels = scene()
    every = np.arange(len(world), dtype=np.int32)
    pairs = _pairs(wTc, np.stack([every, every], axis=1))
    return wTc, world, pixels, pairs, contradictions.rotations(pairs, pixels, K)


def test_rotations_of_a_right_model_are_confirmed_and_denied_by_nobody(told):
    wTc, world, pixels, pairs, found = told
    assert len(found.of) == len(pairs)
    for (i, j), R in found.of.items():
        here = poses.inverse(wTc[j])[:3, :3] @ wTc[i][:3, :3]
        assert np.degrees(poses.rotation_angle(R @ here.T)) < 1
    groups = contradictions.consistent_groups(_placed(wTc, world), found, pairs, pixels)
    assert groups == [set(range(len(wTc)))]


def test_images_that_fit_where_their_pairs_deny_them_are_groups_of_their_own(told):
    """As in a model that is folded: landmarks have moved with the images, and all of them fit."""
    wTc, world, pixels, pairs, found = told
    turned = wTc.copy()
    turned[8:] = turned[8:] @ poses.exp(np.array([0.0, 0, np.radians(12), 0, 0, 0]))
    pixels = [_seen(pose, world) for pose in turned]  # in place, as the model has them
    groups = contradictions.consistent_groups(_placed(turned, world), found, pairs, pixels)
    assert groups == [set(range(8)), set(range(8, 12))]


def test_a_pair_that_no_third_image_confirms_speaks_against_nobody(told):
    _, _, pixels, pairs, _ = told
    lone = {pair: view for pair, view in pairs.items() if pair[1] - pair[0] == 1}
    assert contradictions.rotations(lone, pixels, K).of == {}
    flat = {pair: TwoView(view.matches, view.essential, None, True) for pair, view in pairs.items()}
    assert contradictions.rotations(flat, pixels, K).of == {}


@pytest.mark.parametrize(("shared", "sets"), [(60, [10]), (12, [5, 5]), (0, [5, 5])])
def test_a_bridge_of_few_landmarks_does_not_carry_a_scale(shared, sets):
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


def test_an_image_alone_hangs_by_its_pose():
    wTc, world, _ = scene(count=6, points=80)
    landmark = [np.arange(80)] * 5 + [np.where(np.arange(80) < 12, np.arange(80), -1)]
    model = Placed(landmark, dict(enumerate(wTc)), world, PINHOLE)
    assert bridges.separated(model) == [set(range(6))]
