"""Rigid motions as 4×4 matrices, named `aTb`: coordinates in b to coordinates in a.

Tangent vectors are rotation first, then translation (rad, metres), as in GTSAM's Pose3.
"""

from __future__ import annotations

import math

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


def exp(xi: npt.ArrayLike) -> F64:
    """SE(3) exponential of a tangent vector (6,), rotation first. Barfoot 2017, eq. 7.26.

    On plain numbers: arrays of three cost several times as much, and trackers call this often.
    """
    a, b, c, x, y, z = np.asarray(xi, dtype=np.float64).tolist()
    square = a * a + b * b + c * c
    theta = math.sqrt(square)
    if theta < 1e-2:  # series: the closed forms lose digits here
        first = 1 - square / 6 * (1 - square / 20)
        second = 0.5 - square / 24 * (1 - square / 30)
        third = 1 / 6 - square / 120 * (1 - square / 42)
    elif theta < math.inf:
        first = math.sin(theta) / theta
        second = (1 - math.cos(theta)) / square
        third = (theta - math.sin(theta)) / (square * theta)
    else:
        first = second = third = math.nan
    # ω × v and ω × (ω × v)
    d, e, f = b * z - c * y, c * x - a * z, a * y - b * x
    g, h, i = b * f - c * e, c * d - a * f, a * e - b * d
    return np.array(
        [
            [
                1 - second * (b * b + c * c),
                second * a * b - first * c,
                second * a * c + first * b,
                x + second * d + third * g,
            ],
            [
                second * a * b + first * c,
                1 - second * (a * a + c * c),
                second * b * c - first * a,
                y + second * e + third * h,
            ],
            [
                second * a * c - first * b,
                second * b * c + first * a,
                1 - second * (a * a + b * b),
                z + second * f + third * i,
            ],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def log(aTb: npt.ArrayLike) -> F64:
    """The inverse of `exp`: the tangent vector (6,) of one pose (4, 4). Barfoot 2017, eq. 7.35."""
    T = np.asarray(aTb, dtype=np.float64)
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = T.tolist()
    # Twice the axis times the angle's sine, and twice its cosine.
    a, b, c = r21 - r12, r02 - r20, r10 - r01
    sine, cosine = math.sqrt(a * a + b * b + c * c), r00 + r11 + r22 - 1
    if not math.isfinite(sine + cosine):
        return np.full(6, np.nan)
    theta = math.atan2(sine, cosine)
    if theta < 3.0:
        scale = theta / sine if sine > 1e-12 else 0.5
        a, b, c = a * scale, b * scale, c * scale
    else:  # near half a turn, where that axis loses digits
        a, b, c = Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()
        theta = math.sqrt(a * a + b * b + c * c)
    square = theta * theta
    if theta < 1e-2:
        second = 1 / 12 + square / 720
    else:
        second = (1 - theta / 2 / math.tan(theta / 2)) / square
    d, e, f = b * z - c * y, c * x - a * z, a * y - b * x
    g, h, i = b * f - c * e, c * d - a * f, a * e - b * d
    return np.array(
        [a, b, c, x - d / 2 + second * g, y - e / 2 + second * h, z - f / 2 + second * i]
    )


def adjoint(aTb: npt.ArrayLike) -> F64:
    """(6, 6): takes a tangent vector in b to a, rotation first. Barfoot 2017, eq. 7.45."""
    T = np.asarray(aTb, dtype=np.float64)
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[3:, :3] = np.cross(T[:3, 3], T[:3, :3], axisb=0, axisc=0)
    return result


def rotation_angle(aRb: npt.ArrayLike) -> F64:
    """‖log R‖ of rotations (…, 3, 3), radians."""
    return np.asarray(Rotation.from_matrix(np.asarray(aRb)).magnitude())


def interpolate(wTa: npt.ArrayLike, wTb: npt.ArrayLike, fraction: float) -> F64:
    """The pose at `fraction` of the constant-twist motion from a (0) to b (1), also beyond."""
    wTa = np.asarray(wTa)
    return wTa @ exp(fraction * log(inverse(wTa) @ np.asarray(wTb)))
