"""Poses against GTSAM and SciPy, and what must hold for any of them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from ground_station.geometry import poses

quick = settings(max_examples=60, deadline=None)
numbers = st.floats(-50, 50, allow_nan=False)
units = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
angles = st.one_of(
    st.floats(0, 3.1),
    st.floats(0, 1e-4),  # near the identity, where the closed forms lose digits
    st.floats(np.pi - 1e-3, np.pi - 1e-6),  # near half a turn
)


@st.composite
def tangents(draw: st.DrawFn) -> np.ndarray:
    axis = np.array(draw(units))
    w = axis / np.linalg.norm(axis) * draw(angles)
    return np.concatenate([w, [draw(numbers) for _ in range(3)]])


@st.composite
def some_poses(draw: st.DrawFn) -> np.ndarray:
    return poses.exp(draw(tangents()))


@quick
@given(tangents())
def test_exp_is_the_matrix_exponential(xi: np.ndarray) -> None:
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), xi[:3]), xi[3:]
    np.testing.assert_allclose(poses.exp(xi), expm(twist), atol=1e-9)


@quick
@given(tangents())
def test_log_undoes_exp(xi: np.ndarray) -> None:
    """To a ten-millionth of the way: GTSAM takes a series within 0.06° of half a turn."""
    way = 1 + np.linalg.norm(xi[3:])
    np.testing.assert_allclose(poses.log(poses.exp(xi)), xi, atol=1e-7 * way)


@quick
@given(some_poses(), some_poses())
def test_inverse_and_product_are_gtsams(a: np.ndarray, b: np.ndarray) -> None:
    expected = (gtsam.Pose3(a).inverse() * gtsam.Pose3(b)).matrix()
    np.testing.assert_allclose(poses.inverse(a) @ b, expected, atol=1e-9)
    np.testing.assert_allclose(poses.inverse(a) @ a, np.eye(4), atol=1e-9)


@quick
@given(some_poses())
def test_rotations_stay_proper(a: np.ndarray) -> None:
    again = poses.from_quaternion(a[:3, 3], poses.to_quaternion(a))
    for T in (a, again, poses.inverse(a)):
        R = T[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(again, a, atol=1e-9)


@quick
@given(some_poses(), some_poses())
def test_interpolation_meets_both_ends_and_goes_evenly(a: np.ndarray, b: np.ndarray) -> None:
    if poses.rotation_angle(a[:3, :3].T @ b[:3, :3]) > 3.0:
        return  # the shorter way round is not defined near half a turn
    np.testing.assert_allclose(poses.interpolate(a, b, 0.0), a, atol=1e-9)
    np.testing.assert_allclose(poses.interpolate(a, b, 1.0), b, atol=1e-6)
    middle = poses.interpolate(a, b, 0.5)
    np.testing.assert_allclose(poses.inverse(a) @ middle, poses.inverse(middle) @ b, atol=1e-6)


@quick
@given(some_poses())
def test_transform_is_gtsams(a: np.ndarray) -> None:
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.0]])
    expected = [gtsam.Pose3(a).transformFrom(p) for p in points]
    np.testing.assert_allclose(poses.transform(a, points), expected, atol=1e-9)
    np.testing.assert_allclose(poses.transform(poses.inverse(a), expected), points, atol=1e-9)


def test_rotation_angle_is_the_rotation_vectors_length() -> None:
    vectors = np.array([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.3, -0.4, 0.0], [0.0, 3.1, 0.0]])
    R = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(poses.rotation_angle(R), np.linalg.norm(vectors, axis=1), atol=1e-12)


def test_half_a_turn_has_a_logarithm_that_leads_back() -> None:
    for axis in np.eye(3):
        T = poses.pose(Rotation.from_rotvec(np.pi * axis).as_matrix(), [1.0, -2.0, 3.0])
        np.testing.assert_allclose(poses.exp(poses.log(T)), T, atol=1e-9)
