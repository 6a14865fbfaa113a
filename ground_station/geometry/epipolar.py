"""Two views' epipolar geometry: where the matches of one camera's pixels must lie in another's."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses


def essential(first_wTc: F64, second_wTc: F64) -> F64:
    """E (3, 3) with x₂ᵀ E x₁ = 0 on the planes z = 1 of two cameras with these poses (4, 4)."""
    T = poses.inverse(second_wTc) @ first_wTc
    x, y, z = T[:3, 3]
    return np.asarray(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T[:3, :3])


def sampson_px(first_px: F64, second_px: F64, E: F64, camera_matrix: F64) -> F64:
    """How far matched undistorted pixels (N, 2) are from fitting E (N,), to first order, in px.

    NaN where the cameras stand at one place. Hartley and Zisserman, "Multiple View Geometry",
    section 11.4.3.
    """
    inverse = np.linalg.inv(camera_matrix)
    F = inverse.T @ E @ inverse
    p, q = (np.column_stack([px, np.ones(len(px))]) for px in (first_px, second_px))
    lines, back = p @ F.T, q @ F
    slope = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(np.sum(q * lines, axis=1)) / np.sqrt(slope))
