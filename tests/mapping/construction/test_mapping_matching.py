"""Matches and two-view geometry."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.matching import mutual_matches, verify
from ground_station.mapping.settings import MatchSettings

CAMERA = Camera()


def _unit(values):
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0])
def test_mutual_matches_are_those_of_opencvs_matcher_both_ways(noise):
    rng = np.random.default_rng(1)
    first = _unit(rng.normal(size=(400, 32)))
    second = _unit(first[rng.permutation(400)[:300]] + noise * rng.normal(size=(300, 32)) / 5)
    second = np.concatenate([second, second[:50]])  # twins fail the ratio test
    matcher = cv2.BFMatcher()

    def one_way(a, b):
        return {
            (m.queryIdx, m.trainIdx)
            for m, n in matcher.knnMatch(a, b, 2)
            if m.distance < 0.8 * n.distance
        }

    expected = one_way(first, second) & {(i, j) for j, i in one_way(second, first)}
    found = {tuple(pair) for pair in mutual_matches(first, second, 0.8).tolist()}
    assert found == expected
    assert len(found) > 20


def test_images_with_hardly_any_features_have_no_matches():
    few, many = _unit(np.ones((1, 8))), _unit(np.random.default_rng(0).normal(size=(9, 8)))
    assert mutual_matches(few, many, 0.8).shape == (0, 2)
    assert mutual_matches(many, few[:0], 0.8).shape == (0, 2)


RULES = MatchSettings(min_inliers=8, min_inlier_ratio=0.0)


def _two_views(points, rotation, translation, rng, noise_px=0.3):
    first = CAMERA.project(points)
    second = CAMERA.project(points @ rotation.T + translation)
    return [px + noise_px * rng.normal(size=px.shape) for px in (first, second)]


def _verify(first, second):
    every = np.arange(len(first), dtype=np.int32)
    matches = np.stack([every, every], axis=1)
    return verify(first, second, matches, CAMERA.matrix, RULES)


def test_verification_finds_the_geometry_among_wrong_matches():
    rng = np.random.default_rng(2)
    points = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (300, 3))
    rotation = Rotation.from_rotvec([0.05, -0.1, 0.02]).as_matrix()
    translation = np.array([0.8, 0.1, 0.1])
    first, second = _two_views(points, rotation, translation, rng)
    second[:100] = rng.uniform(0, 480, (100, 2))
    view = _verify(first, second)
    assert view is not None and not view.degenerate
    right = view.matches[:, 0] >= 100
    assert right.sum() > 190 and (~right).sum() < 12
    tx, ty, tz = translation
    E = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ rotation
    E, found = E / np.linalg.norm(E), view.essential / np.linalg.norm(view.essential)
    assert min(np.abs(E - found).max(), np.abs(E + found).max()) < 0.03


def test_planes_and_pure_turns_are_called_degenerate():
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec([0.0, 0.15, 0.0]).as_matrix()
    room = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (300, 3))
    plane = np.column_stack([rng.uniform([-2, -1.5], [2, 1.5], (300, 2)), np.full(300, 5.0)])
    for points, translation in ((room, [0.0, 0.0, 0.0]), (plane, [0.7, 0.0, 0.0])):
        view = _verify(*_two_views(points, turn, np.array(translation), rng))
        assert view is not None and view.degenerate
        assert len(view.matches) > 270


def test_too_few_matches_have_no_geometry():
    assert _verify(np.zeros((5, 2)), np.zeros((5, 2))) is None
    assert _verify(np.full((40, 2), 7.0), np.full((40, 2), 7.0)) is None
