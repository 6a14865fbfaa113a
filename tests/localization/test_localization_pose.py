"""One pose from its observations: both solvers, against truth, each other and Monte Carlo.

Solved by rows, it is that of a global shutter, of whose motion nothing is predicted.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from synthetic import apart

from ground_station.geometry import poses
from ground_station.localization.kinematics import Kinematics, LandmarkObservations
from ground_station.localization.pose_alone import reprojection_px, solve_graph
from ground_station.localization.pose_rolling import solve_rolling
from ground_station.localization.settings import PoseSettings

SOLVERS = [solve_graph, solve_rolling]
TRUE = poses.exp([0.1, -0.4, 0.2, 1.0, 2.0, 3.0])
GUESS = TRUE @ poses.exp([0.02, -0.03, 0.02, 0.08, -0.05, 0.06])


def _scene(camera, rng, count=300, noise_px=1.0, outliers=0.0, landmark_noise_m=0.0):
    points_c = rng.uniform([-0.55, -0.42, 0], [0.55, 0.42, 0], (count, 3))
    depth = rng.uniform(2, 8, count)
    points_c = np.c_[points_c[:, :2] * depth[:, None], depth]
    flat = points_c[:, :2] / points_c[:, 2:]
    pixels = flat * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    pixels = pixels + rng.normal(0, noise_px, (count, 2))
    wrong = rng.random(count) < outliers
    pixels[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    points = poses.transform(TRUE, points_c)
    return points + rng.normal(0, landmark_noise_m, points.shape), pixels, wrong


def run(solve, guess, points, pixels, camera, settings):
    none = np.zeros(len(points))
    free = np.tile(settings.landmark_sigma_m**2 * np.eye(3), (len(points), 1, 1))
    observations = LandmarkObservations(
        points, pixels, none, none + settings.sigma_px, free, none + 1, np.zeros_like(points)
    )
    unknown = np.diag(np.repeat([1e8, 1.0], 6))
    guess = Kinematics(0, guess, np.zeros(6), unknown)
    return solve(guess, observations, camera, settings)


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_pose_is_found_among_a_fifth_of_outliers(room, solve):
    rng = np.random.default_rng(11)
    points, pixels, wrong = _scene(room.camera, rng, outliers=0.2)
    solution = run(solve, GUESS, points, pixels, room.camera, PoseSettings())
    assert solution.state is not None, solution.reason
    metres, radians = apart(solution.state.wTc, TRUE)
    assert metres < 0.01 and radians < np.deg2rad(0.1)
    assert solution.inlier[~wrong].mean() > 0.99
    assert solution.inlier[wrong].mean() < 0.2
    R = solution.state.wTc[:3, :3]
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-9


def test_both_solvers_find_the_same_optimum_when_landmarks_are_certain(room):
    rng = np.random.default_rng(12)
    points, pixels, _ = _scene(room.camera, rng, outliers=0.2)
    settings = PoseSettings(landmark_sigma_m=1e-5)
    graph, rolling = (run(solve, GUESS, points, pixels, room.camera, settings) for solve in SOLVERS)
    assert max(apart(rolling.state.wTc, graph.state.wTc)) < 1e-4
    covariances = (each.state.covariance[:6, :6] for each in (graph, rolling))
    assert np.allclose(*covariances, rtol=0.02, atol=1e-9)


def test_the_pose_is_opencvs_when_nothing_is_wrong(room):
    rng = np.random.default_rng(13)
    points, pixels, _ = _scene(room.camera, rng, noise_px=0.3)
    settings = PoseSettings(landmark_sigma_m=1e-5, huber_k=100)
    ours = run(solve_rolling, GUESS, points, pixels, room.camera, settings).state.wTc
    found, rvec, tvec = cv2.solvePnP(points, pixels, room.camera.matrix, None)
    assert found
    theirs = poses.inverse(poses.pose(cv2.Rodrigues(rvec)[0], tvec.ravel()))
    assert max(apart(ours, theirs)) < 1e-4


def test_the_graphs_covariance_is_that_of_repeated_trials(room):
    settings = PoseSettings(sigma_px=1.0, landmark_sigma_m=0.01, huber_k=10)
    errors, stated = [], []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        points, pixels, _ = _scene(room.camera, rng, count=60, landmark_noise_m=0.01)
        solution = run(solve_graph, TRUE, points, pixels, room.camera, settings)
        errors.append(poses.log(poses.inverse(solution.state.wTc) @ TRUE))
        stated.append(np.diag(solution.state.covariance)[:6])
    ratio = np.square(errors).mean(axis=0) / np.mean(stated, axis=0)
    assert (ratio > 0.45).all() and (ratio < 2.0).all(), ratio


def test_one_point_seen_twenty_times_has_no_pose_and_no_exception(room):
    point = poses.transform(TRUE, np.array([[0.0, 0.0, 3.0]]))
    points, pixels = np.repeat(point, 20, axis=0), np.full((20, 2), 200.0)
    settings = PoseSettings(landmark_sigma_m=1e-5)
    same = run(solve_graph, TRUE, points, pixels, room.camera, settings)
    assert same.state is None and same.reason


@pytest.mark.parametrize("solve", SOLVERS)
def test_points_behind_the_camera_have_no_pose_and_no_exception(room, solve):
    points = poses.transform(TRUE, np.array([[0.1, 0.0, -3.0]])) + np.zeros((20, 3))
    pixels, settings = np.full((20, 2), 200.0), PoseSettings(landmark_sigma_m=1e-5)
    solution = run(solve, TRUE, points, pixels, room.camera, settings)
    assert solution.state is None and solution.reason
    assert not solution.inlier.any()


def test_rejecting_outliers_brings_the_pose_closer(room):
    rng = np.random.default_rng(15)
    points, pixels, _ = _scene(room.camera, rng, outliers=0.35)
    pixels[::4] += [12.0, 6.0]  # a quarter is off to one side, as matches to a repeated pattern are
    plain = PoseSettings(inlier_px=6.0)
    strict = dataclasses.replace(plain, reject_outliers=True)
    before, after = (
        run(solve_rolling, GUESS, points, pixels, room.camera, s).state.wTc for s in (plain, strict)
    )
    assert np.hypot(*apart(after, TRUE)) < np.hypot(*apart(before, TRUE))


def test_points_behind_the_camera_are_infinitely_far_off(room):
    points = poses.transform(TRUE, np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]]))
    centre = np.tile([room.camera.cx_px, room.camera.cy_px], (2, 1))
    residual = reprojection_px(room.camera, TRUE, points, centre)
    assert residual[0] < 1e-9 and np.isinf(residual[1])
