"""The thesis's pose: a GTSAM graph of projection factors on one pose and its landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import PoseSettings


@dataclass(frozen=True)
class PoseSolution:
    """What a solver found; `wTc` is None when it failed, and `reason` says why.

    `covariance` (6, 6) is of the right tangent wTc·exp(ξ), rotation (rad) before translation (m),
    as of GTSAM's Pose3. `residual_px` (N,) belongs to the observations given, `inlier` (N,) too.
    """

    wTc: F64 | None
    covariance: F64 | None
    residual_px: F64
    inlier: Bools
    iterations: int
    reason: str = ""


def failure(count: int, iterations: int, reason: str) -> PoseSolution:
    """A solution that is none."""
    return PoseSolution(
        None, None, np.full(count, np.inf), np.zeros(count, bool), iterations, reason
    )


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
    wTc: F64, points_w: F64, pinhole_px: F64, camera: Camera, settings: PoseSettings
) -> PoseSolution:
    """The pose that explains undistorted pixels (N, 2) of landmarks (N, 3), from a guess (4, 4).

    Variables are the pose and every landmark. Factors: a pinhole projection with sigma and Huber's
    loss for each observation, and a prior on each landmark. Gauss-Newton. The covariance is the
    pose's marginal of the reweighted graph. A singular graph or no convergence is a failure.
    """
    n = len(points_w)
    K = gtsam.Cal3_S2(camera.fx_px, camera.fy_px, 0.0, camera.cx_px, camera.cy_px)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(settings.huber_k),
        gtsam.noiseModel.Isotropic.Sigma(2, settings.sigma_px),
    )
    prior = gtsam.noiseModel.Isotropic.Sigma(3, settings.landmark_sigma_m)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(X(0), gtsam.Pose3(wTc))
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
            return failure(n, iterations, f"not converged in {iterations} iterations")
        if not np.isfinite(solved).all() or not np.isfinite(error):
            return failure(n, iterations, "not finite")
        if error > graph.error(values) * (1 + 1e-6) + 1e-6:
            return failure(n, iterations, "diverged")
        covariance = np.asarray(gtsam.Marginals(graph, result).marginalCovariance(X(0)))
    except RuntimeError:  # GTSAM's way of saying that the system is singular
        return failure(n, 0, "singular")
    residual = reprojection_px(camera, solved, points_w, pinhole_px)
    return PoseSolution(solved, covariance, residual, residual < settings.inlier_px, iterations)
