"""The same pose without landmark variables: vectorised, damped Gauss-Newton on SE(3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.pose_graph import PoseSolution, failure, reprojection_px
from ground_station.localization.settings import PoseSettings

Array = npt.NDArray[np.float64]

_STEP = 1e-6
"""Converged when the tangent step (rad, m) is shorter: far below any pose's own uncertainty."""

_NEAREST_M = 1e-3
"""A point nearer than this, or behind, has no projection."""

_BEHIND_COST = 1e6
"""What such a point costs, so that no step gains by turning away from it."""


def solve_direct(
    wTc: Array, points_w: Array, pinhole_px: Array, camera: Camera, settings: PoseSettings
) -> PoseSolution:
    """The pose that explains undistorted pixels (N, 2) of landmarks (N, 3), from a guess (4, 4).

    Each landmark's prior is marginalised to first order into the variance of its observation,
    sigma² + (f·σ_landmark/z)². Huber's loss by reweighting, Levenberg's damping when a step would
    raise the cost. With `reject_outliers` it is solved once more from the inliers alone.
    """
    inlier = np.ones(len(points_w), bool)
    iterations = 0
    for _ in range(2 if settings.reject_outliers else 1):
        count = int(inlier.sum())
        if count < settings.min_inliers:
            return failure(len(points_w), iterations, f"{count} inliers")
        solved, information, steps, reason = _descend(
            wTc, points_w[inlier], pinhole_px[inlier], camera, settings
        )
        iterations += steps
        if solved is None:
            return failure(len(points_w), iterations, reason)
        wTc = solved
        residual = reprojection_px(camera, wTc, points_w, pinhole_px)
        inlier = residual < settings.inlier_px
    if np.linalg.cond(information) > 1e14:
        return failure(len(points_w), iterations, "singular")
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return PoseSolution(wTc, covariance, residual, inlier, iterations)


def _descend(
    wTc: Array, points_w: Array, pinhole_px: Array, camera: Camera, settings: PoseSettings
) -> tuple[Array | None, Array, int, str]:
    damping = 0.0
    # Frozen at the first pose: a variance that moved with the depth would make costs of two poses
    # incomparable.
    depth = np.maximum(((points_w - wTc[:3, 3]) @ wTc[:3, :3])[:, 2], _NEAREST_M)
    variance = settings.sigma_px**2 + (camera.fx_px * settings.landmark_sigma_m / depth) ** 2
    observed = (points_w, pinhole_px, variance)
    information, gradient, cost = _linearize(wTc, *observed, camera, settings.huber_k)
    for iteration in range(1, settings.max_iterations + 1):
        try:
            damped = information + damping * np.diag(np.diag(information))
            step = -np.linalg.solve(damped, gradient)
        except np.linalg.LinAlgError:
            return None, information, iteration, "singular"
        if not np.isfinite(step).all():
            return None, information, iteration, "not finite"
        candidate = wTc @ poses.exp(step)
        linear = _linearize(candidate, *observed, camera, settings.huber_k)
        if linear[2] > cost * (1 + 1e-12):
            damping = max(10 * damping, 1e-4)
            if damping > 1e8:
                return None, information, iteration, "diverged"
            continue
        wTc, damping = candidate, damping / 10 if damping > 1e-6 else 0.0
        information, gradient, cost = linear
        if np.linalg.norm(step) < _STEP:
            return wTc, information, iteration, ""
    return (
        None,
        information,
        settings.max_iterations,
        (f"not converged in {settings.max_iterations} iterations"),
    )


def _linearize(
    wTc: Array,
    points_w: Array,
    pinhole_px: Array,
    variance_px2: Array,
    camera: Camera,
    huber_k: float,
) -> tuple[Array, Array, float]:
    """Information (6, 6), gradient (6,) and Huber cost at a pose, right tangent, rotation first."""
    points = (points_w - wTc[:3, 3]) @ wTc[:3, :3]
    front = points[:, 2] > _NEAREST_M
    x, y, z = points[front].T
    variance = variance_px2[front]
    fx, fy = camera.fx_px, camera.fy_px
    u, v, zero = x / z, y / z, np.zeros_like(z)
    r = np.stack([fx * u + camera.cx_px, fy * v + camera.cy_px]) - pinhole_px[front].T
    # The pinhole's derivative times ∂p_c/∂ξ = [hat(p_c), −I]: rows of u, rows of v, (2, N, 6).
    J = np.stack(
        [
            fx * np.stack([u * v, -1 - u * u, v, -1 / z, zero, u / z], axis=1),
            fy * np.stack([1 + v * v, -u * v, -u, zero, -1 / z, v / z], axis=1),
        ]
    )
    norm = np.sqrt((r * r).sum(axis=0) / variance)
    weight = np.where(norm <= huber_k, 1.0, huber_k / np.maximum(norm, huber_k)) / variance
    cost = np.where(norm <= huber_k, 0.5 * norm**2, huber_k * (norm - 0.5 * huber_k)).sum()
    cost += (len(front) - len(z)) * _BEHIND_COST
    root = np.sqrt(weight)
    A = (J * root[:, None]).reshape(-1, 6)
    return A.T @ A, A.T @ (r * root).ravel(), float(cost)
