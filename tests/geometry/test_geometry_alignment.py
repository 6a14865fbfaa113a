"""Umeyama's alignment: what it recovers, what it refuses, and evo's."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ground_station.errors import GeometryError
from ground_station.geometry.alignment import align

seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=60, deadline=None)


def similarity(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float]:
    R = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return R, rng.uniform(-20, 20, 3), float(rng.uniform(0.05, 20))


@quick
@given(seeds, st.integers(3, 40))
def test_a_similarity_is_recovered(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    R, t, c = similarity(rng)
    x = rng.normal(size=(n, 3)) * 3
    found = align(x, c * x @ R.T + t, with_scale=True)
    np.testing.assert_allclose(found.rotation, R, atol=1e-6)
    np.testing.assert_allclose(found.translation, t, atol=1e-5)
    assert found.scale == pytest.approx(c, rel=1e-6)
    np.testing.assert_allclose(found.apply(x), c * x @ R.T + t, atol=1e-6)


@quick
@given(seeds)
def test_noisy_pairs_align_as_evo_aligns_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, t, c = similarity(rng)
    x = rng.normal(size=(30, 3))
    y = c * x @ R.T + t + rng.normal(size=(30, 3)) * 0.3
    for with_scale in (False, True):
        found = align(x, y, with_scale)
        r, shift, scale = umeyama_alignment(x.T, y.T, with_scale)
        np.testing.assert_allclose(found.rotation, r, atol=1e-9)
        np.testing.assert_allclose(found.translation, shift, atol=1e-9)
        assert found.scale == pytest.approx(scale, rel=1e-12)


@quick
@given(seeds)
def test_no_small_motion_improves_the_result(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(12, 3)), rng.normal(size=(12, 3))
    w = rng.uniform(0.1, 2, 12)
    found = align(x, y, with_scale=False, weights=w)
    best = np.sum(w * np.sum((y - found.apply(x)) ** 2, axis=1))
    nudge = Rotation.from_rotvec(rng.normal(size=3) * 1e-3).as_matrix()
    turned = x @ (nudge @ found.rotation).T
    moved = turned + np.average(y - turned, axis=0, weights=w)
    assert best <= np.sum(w * np.sum((y - moved) ** 2, axis=1)) + 1e-9


def test_a_mirrored_set_gets_a_proper_rotation() -> None:
    x = np.random.default_rng(3).normal(size=(20, 3))
    found = align(x, x * [1, 1, -1], with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_points_in_a_plane_are_enough() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [3, 1, 0]])
    R = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    np.testing.assert_allclose(align(x, x @ R.T + 1, False).rotation, R, atol=1e-12)


def test_a_weight_of_zero_leaves_a_point_out_and_a_weight_of_two_counts_it_twice() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(8, 3)), rng.normal(size=(8, 3))
    w = np.array([1, 1, 1, 1, 1, 1, 2, 0])
    twice = np.r_[0:7, 6]
    np.testing.assert_allclose(
        align(x, y, True, w).apply(x), align(x[twice], y[twice], True).apply(x), atol=1e-12
    )


def test_poses_turn_with_their_positions() -> None:
    R, t, c = similarity(np.random.default_rng(8))
    x = np.random.default_rng(9).normal(size=(5, 3))
    found = align(x, c * x @ R.T + t, True)
    wTc = np.tile(np.eye(4), (5, 1, 1))
    wTc[:, :3, 3] = x
    moved = found.apply_poses(wTc)
    np.testing.assert_allclose(moved[:, :3, 3], found.apply(x), atol=1e-12)
    np.testing.assert_allclose(moved[:, :3, :3], np.tile(R, (5, 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(wTc[:, :3, 3], x)  # the input stays as it was


LINE = np.outer(np.arange(10.0), [1.0, 2.0, -1.0]) + 5


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (np.eye(3)[:2], np.eye(3)[:2]),
        (np.empty((0, 3)), np.empty((0, 3))),
        (LINE, LINE),
        (LINE, np.random.default_rng(1).normal(size=(10, 3))),
        (np.ones((5, 3)), np.ones((5, 3))),
        (np.full((4, 3), np.nan), np.eye(4)[:, :3]),
        (np.eye(3), np.array([[np.inf, 0, 0], [0, 1, 0], [0, 0, 1]])),
    ],
)
def test_what_does_not_determine_a_motion_is_refused(
    source: np.ndarray, target: np.ndarray
) -> None:
    for with_scale in (False, True):
        with pytest.raises(GeometryError, match=r"^alignment: [^\n]+$"):
            align(source, target, with_scale)


def test_weights_that_leave_two_points_are_refused() -> None:
    with pytest.raises(GeometryError):
        align(np.eye(3), np.eye(3), False, [1, 1, 0])
