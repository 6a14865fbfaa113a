"""Rigid motions as 4×4 matrices, named `aTb`: coordinates in b to coordinates in a.

Tangent vectors are rotation first, then translation (rad, metres), as in GTSAM's Pose3.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64


def pose(rotation: npt.ArrayLike, translation_m: npt.ArrayLike) -> F64:
    """4×4 (or N×4×4) from rotation matrices (…, 3, 3) and translations (…, 3), metres."""
    R = np.asarray(rotation, dtype=np.float64)
    result = np.zeros((*R.shape[:-2], 4, 4))
    result[..., :3, :3] = R
    result[..., :3, 3] = translation_m
    result[..., 3, 3] = 1.0
    return result


def from_quaternion(position_m: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike) -> F64:
    """Positions (…, 3), metres, and unit quaternions x, y, z, w (…, 4) to poses (…, 4, 4)."""
    return pose(Rotation.from_quat(np.asarray(quaternion_xyzw)).as_matrix(), position_m)


def to_quaternion(wTc: npt.ArrayLike) -> F64:
    """The rotation of poses (…, 4, 4) as unit quaternions x, y, z, w (…, 4), w >= 0."""
    T = np.asarray(wTc)
    return np.asarray(Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True))


def inverse(aTb: npt.ArrayLike) -> F64:
    """`bTa` of poses (…, 4, 4), by transposition."""
    T = np.asarray(aTb, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(Rt, -np.einsum("...ij,...j->...i", Rt, T[..., :3, 3]))


def transform(aTb: npt.ArrayLike, points_b: npt.ArrayLike) -> F64:
    """Points (N, 3) in b to coordinates in a, for one pose (4, 4)."""
    T = np.asarray(aTb)
    return np.asarray(np.asarray(points_b) @ T[:3, :3].T + T[:3, 3])


def in_each(wTc: F64, points_w: F64) -> F64:
    """Points (N, 3) of the world, or one (3,), each in the axes of its camera of N (N, 4, 4)."""
    return np.asarray(np.einsum("oji,oj->oi", wTc[:, :3, :3], points_w - wTc[:, :3, 3]))


def exp(xi: npt.ArrayLike) -> F64:
    """SE(3) exponential (4, 4) of a tangent vector (6,), rotation first."""
    import gtsam  # here, and below: four tenths of a second for who has no tangent vectors

    motion = gtsam.Pose3.Expmap(np.asarray(xi, dtype=np.float64))
    return np.ascontiguousarray(motion.matrix())


def log(aTb: npt.ArrayLike) -> F64:
    """The inverse of `exp`: the tangent vector (6,) of one pose (4, 4)."""
    import gtsam

    motion = gtsam.Pose3(np.asarray(aTb, dtype=np.float64))
    return np.asarray(gtsam.Pose3.Logmap(motion))


def adjoint(aTb: npt.ArrayLike) -> F64:
    """(6, 6): takes a tangent vector in b to a, rotation first. Barfoot 2017, eq. 7.45."""
    import gtsam

    motion = gtsam.Pose3(np.asarray(aTb, dtype=np.float64))
    return np.ascontiguousarray(motion.AdjointMap())


def rotation_angle(aRb: npt.ArrayLike) -> F64:
    """‖log R‖ of rotations (…, 3, 3), radians."""
    return np.asarray(Rotation.from_matrix(np.asarray(aRb)).magnitude())


def interpolate(wTa: npt.ArrayLike, wTb: npt.ArrayLike, fraction: float) -> F64:
    """The pose at `fraction` of the constant-twist motion from a (0) to b (1), also beyond."""
    wTa = np.asarray(wTa)
    return wTa @ exp(fraction * log(inverse(wTa) @ np.asarray(wTb)))
