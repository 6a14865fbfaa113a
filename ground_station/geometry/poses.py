"""Rigid motions as 4×4 matrices, named `aTb`: coordinates in b to coordinates in a.

Tangent vectors are rotation first, then translation (rad, metres), as in GTSAM's Pose3.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


def pose(rotation: npt.ArrayLike, translation_m: npt.ArrayLike) -> Array:
    """4×4 (or N×4×4) from rotation matrices (…, 3, 3) and translations (…, 3), metres."""
    R = np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*R.shape[:-2], 4, 4))
    result[..., :3, :3] = R
    result[..., :3, 3] = translation_m
    result[..., 3, 3] = 1.0
    return result


def from_quaternion(position_m: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike) -> Array:
    """Positions (…, 3), metres, and unit quaternions x, y, z, w (…, 4) to poses (…, 4, 4)."""
    return pose(Rotation.from_quat(np.asarray(quaternion_xyzw)).as_matrix(), position_m)


def to_quaternion(wTc: npt.ArrayLike) -> Array:
    """The rotation of poses (…, 4, 4) as unit quaternions x, y, z, w (…, 4), w >= 0."""
    T = np.asarray(wTc)
    return Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)


def inverse(aTb: npt.ArrayLike) -> Array:
    """`bTa` of poses (…, 4, 4), by transposition."""
    T = np.asarray(aTb, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3]))


def transform(aTb: npt.ArrayLike, points_b: npt.ArrayLike) -> Array:
    """Points (N, 3) in b to coordinates in a, for one pose (4, 4)."""
    T = np.asarray(aTb)
    return np.asarray(points_b) @ T[:3, :3].T + T[:3, 3]


def _hat(w: Array) -> Array:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def exp(xi: npt.ArrayLike) -> Array:
    """SE(3) exponential of a tangent vector (6,), rotation first. Barfoot 2017, eq. 7.26."""
    xi = np.asarray(xi, dtype=np.float64)
    w, v = xi[:3], xi[3:]
    theta = float(np.linalg.norm(w))
    W = _hat(w)
    if theta < 1e-5:  # series to third order: the closed forms lose digits here
        V = np.eye(3) + W / 2 + W @ W / 6
    else:
        V = (
            np.eye(3)
            + (1 - np.cos(theta)) / theta**2 * W
            + (theta - np.sin(theta)) / theta**3 * (W @ W)
        )
    return pose(Rotation.from_rotvec(w).as_matrix(), V @ v)


def log(aTb: npt.ArrayLike) -> Array:
    """The inverse of `exp`: the tangent vector (6,) of one pose (4, 4). Barfoot 2017, eq. 7.35."""
    T = np.asarray(aTb, dtype=np.float64)
    w = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    theta = float(np.linalg.norm(w))
    W = _hat(w)
    if theta < 1e-5:
        V_inv = np.eye(3) - W / 2 + W @ W / 12
    else:
        half = theta / 2
        V_inv = np.eye(3) - W / 2 + (1 - half / np.tan(half)) / theta**2 * (W @ W)
    return np.concatenate([w, V_inv @ T[:3, 3]])


def rotation_angle(aRb: npt.ArrayLike) -> Array:
    """‖log R‖ of rotations (…, 3, 3), radians."""
    return np.asarray(Rotation.from_matrix(np.asarray(aRb)).magnitude())


def interpolate(wTa: npt.ArrayLike, wTb: npt.ArrayLike, fraction: float) -> Array:
    """The pose at `fraction` of the constant-twist motion from a (0) to b (1), also beyond."""
    wTa = np.asarray(wTa)
    return wTa @ exp(fraction * log(inverse(wTa) @ np.asarray(wTb)))
