"""A frame's pose from that frame alone, by the thesis's graph of GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.localization.kinematics import (
    Kinematics,
    LandmarkObservations,
    Solution,
    no_solution,
)
from ground_station.localization.settings import PoseSettings


def reprojection_px(camera: Camera, wTc: F64, points_w: F64, pinhole_px: F64) -> F64:
    """Distances (N,) between undistorted pixels (N, 2) and projected points (N, 3), pixels.

    Points behind the camera are infinitely far off.
    """
    points = (points_w - wTc[:3, 3]) @ wTc[:3, :3]
    front = points[:, 2] > 1e-6
    result = np.full(len(points), np.inf)
    xy = points[front, :2] / points[front, 2:]
    offset = xy * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px] - pinhole_px[front]
    result[front] = np.linalg.norm(offset, axis=1)
    return result


def solve_graph(
    guess: Kinematics, observations: LandmarkObservations, camera: Camera, settings: PoseSettings
) -> Solution:
    """The pose that explains N landmarks seen at undistorted pixels, from a guess of it.

    Variables are the pose and every landmark. Factors: a pinhole projection with sigma and Huber's
    loss for each observation, and a prior on each landmark. Gauss-Newton. The covariance is the
    pose's marginal of the reweighted graph. A singular graph or no convergence is a failure.
    """
    n, points_w, pinhole_px = len(observations), observations.points_m, observations.pinhole_px
    K = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0.0, camera.cx_px, camera.cy_px)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(settings.huber_k),
        gtsam.noiseModel.Isotropic.Sigma(2, settings.sigma_px),
    )
    prior = gtsam.noiseModel.Isotropic.Sigma(3, settings.landmark_sigma_m)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(X(0), gtsam.Pose3(guess.wTc))
    for i in range(n):
        key = L(i)
        values.insert(key, points_w[i])
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pinhole_px[i], noise, X(0), key, K))
        graph.add(gtsam.PriorFactorPoint3(key, points_w[i], prior))
    params = gtsam.GaussNewtonParams()
    params.setMaxIterations(settings.max_iterations)
    try:
        optimizer = gtsam.GaussNewtonOptimizer(graph, values, params)
        result = optimizer.optimize()
        iterations = int(optimizer.iterations())
        solved = np.asarray(result.atPose3(X(0)).matrix())
        error = graph.error(result)
        if iterations >= settings.max_iterations:
            return no_solution(n, f"not converged in {iterations} iterations", iterations)
        if not np.isfinite(solved).all() or not np.isfinite(error):
            return no_solution(n, "not finite", iterations)
        if error > graph.error(values) * (1 + 1e-6) + 1e-6:
            return no_solution(n, "diverged", iterations)
        covariance = np.asarray(gtsam.Marginals(graph, result).marginalCovariance(X(0)))
    except RuntimeError:  # GTSAM's way of saying that the system is singular
        return no_solution(n, "singular")
    residual = reprojection_px(camera, solved, points_w, pinhole_px)
    full = np.zeros((12, 12))  # of a velocity it knows nothing
    full[:6, :6] = covariance
    return Solution(
        Kinematics(guess.time_ns, solved, np.zeros(6), full), np.zeros((12, 12)), np.zeros(12),
        residual, residual < settings.inlier_px, iterations=iterations,
    )  # fmt: skip
