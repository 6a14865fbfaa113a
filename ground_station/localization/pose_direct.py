"""The same pose without landmark variables: vectorised, damped Gauss-Newton on SE(3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.pose_graph import PoseSolution, failure, reprojection_px
from ground_station.localization.settings import PoseSettings

Array = npt.NDArray[np.float64]

_STEP = 1e-5
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
    sigma² + (f·σ_landmark/z)², and into the reach of Huber's loss, which is minimised by
    reweighting; Levenberg's damping when a step would raise the cost. With `reject_outliers` it is
    solved once more from the inliers alone.
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
    information, gradient, cost = _linearize(wTc, *observed, camera, settings)
    for iteration in range(1, settings.max_iterations + 1):
        try:
            damped = information + damping * np.diag(np.diag(information))
            step = -np.linalg.solve(damped, gradient)
        except np.linalg.LinAlgError:
            return None, information, iteration, "singular"
        if not np.isfinite(step).all():
            return None, information, iteration, "not finite"
        candidate = wTc @ poses.exp(step)
        linear = _linearize(candidate, *observed, camera, settings)
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
    settings: PoseSettings,
) -> tuple[Array, Array, float]:
    """Information (6, 6), gradient (6,) and Huber cost at a pose, right tangent, rotation first."""
    huber_k, sigma_px = settings.huber_k, settings.sigma_px
    points = wTc[:3, :3].T @ (points_w - wTc[:3, 3]).T
    observed, variance, behind = pinhole_px.T, variance_px2, 0
    front = points[2] > _NEAREST_M
    if not front.all():
        points, observed, variance = points[:, front], observed[:, front], variance[front]
        behind = len(front) - points.shape[1]
    fx, fy = camera.fx_px, camera.fy_px
    inverse_z = 1.0 / points[2]
    u, v = points[0] * inverse_z, points[1] * inverse_z
    r = np.stack([fx * u + (camera.cx_px - observed[0]), fy * v + (camera.cy_px - observed[1])])
    norm = np.sqrt((r * r).sum(axis=0) / variance)
    # Huber on what is left of a residual when its landmark has moved: the quadratic part reaches
    # as far as the noise of the pixel alone allows.
    limit = huber_k * np.sqrt(variance) / sigma_px
    clipped = np.minimum(norm, limit)
    cost = float((clipped * (norm - 0.5 * clipped)).sum()) + behind * _BEHIND_COST
    root = np.sqrt(limit / np.maximum(norm, limit) / variance)
    # The pinhole's derivative times ∂p_c/∂ξ = [hat(p_c), −I], weighted: (6, 2, N).
    J = np.zeros((6, 2, len(u)))
    x, y = fx * root, fy * root
    np.multiply(x, u * v, out=J[0, 0])
    np.multiply(-x, 1 + u * u, out=J[1, 0])
    np.multiply(x, v, out=J[2, 0])
    np.multiply(-x, inverse_z, out=J[3, 0])
    np.multiply(-J[3, 0], u, out=J[5, 0])
    np.multiply(y, 1 + v * v, out=J[0, 1])
    np.multiply(-y, u * v, out=J[1, 1])
    np.multiply(-y, u, out=J[2, 1])
    np.multiply(-y, inverse_z, out=J[4, 1])
    np.multiply(-J[4, 1], v, out=J[5, 1])
    A = J.reshape(6, -1)
    return A @ A.T, A @ (r * root).ravel(), cost
