"""From the project's conventions to ROS's: axes, covariance order, stamps. Pure functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.service.bus_messages import EstimateMessage, FrameMessage

MAP = "map"
OPTICAL_IN_CAMERA = poses.pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""cTo: optical axes (x right, y down, z forward) in a body's (x forward, y left, z up), REP 103."""

ELLIPSOID_SIGMAS = 2.7955
"""An ellipsoid of so many standard deviations holds 95 % of a normal distribution in space: the
square root of chi-square's quantile at 0.95 with three degrees of freedom, 7.8147."""
_LEAST_M = 1e-3


@dataclass(frozen=True)
class Solved:
    """A pose as it goes out: `wTc` (4, 4) of the body axes; `covariance` (6, 6) in ROS's order."""

    wTc: F64
    covariance: F64 | None

    @property
    def position_m(self) -> list[float]:
        """x, y, z."""
        values: list[float] = self.wTc[:3, 3].tolist()
        return values

    @property
    def quaternion_xyzw(self) -> list[float]:
        """x, y, z, w."""
        values: list[float] = poses.to_quaternion(self.wTc).tolist()
        return values


def solved(note: EstimateMessage) -> Solved | None:
    """A message's pose; None when it has none."""
    if note.position_m is None or note.quaternion_xyzw is None:
        return None
    wTo = poses.from_quaternion(note.position_m, note.quaternion_xyzw)
    covariance = None if note.covariance is None else ros_covariance(wTo, note.covariance)
    return Solved(body_pose(wTo), covariance)


def stamp_ns(note: FrameMessage | EstimateMessage) -> int:
    """When its picture was taken, on this machine's clock; arrival or solution while unknown."""
    if note.capture_ns is not None:
        return note.capture_ns
    return note.arrival_ns if isinstance(note, FrameMessage) else note.done_ns


def camera_frame(payload_id: str) -> str:
    """The camera's frame with a body's axes: x forward, y left, z up."""
    return f"{payload_id}/camera"


def optical_frame(payload_id: str) -> str:
    """The camera's frame with the picture's axes: x right, y down, z forward."""
    return f"{payload_id}/camera_optical"


def body_pose(wTo: npt.ArrayLike) -> F64:
    """The pose (4, 4) of a camera's body axes from that of its optical axes (4, 4)."""
    return np.asarray(wTo) @ poses.inverse(OPTICAL_IN_CAMERA)


def ros_covariance(wTc: npt.ArrayLike, covariance: npt.ArrayLike) -> F64:
    """A covariance (6, 6) in the order and axes of `geometry_msgs/PoseWithCovariance`.

    In: of the right tangent ξ = (ω, v) of wTc (4, 4), wTc·exp(ξ), rad and metres, camera axes. Out:
    position x, y, z, then the rotation about the map's fixed x, y, z. With wTc = (R, p) it is
    exp(Rω)·R for the rotation and p + R·v for the position, to first order in ω (Barfoot 2017,
    section 7.1.5: adjoint, less the part that moves the map's origin): J·Σ·Jᵀ, J = [0 R; R 0].
    A rotation about fixed axes is the same for any axes of the camera, optical or body's. These
    are small rotations, not differences of roll, pitch and yaw, which differ away from the level.
    """
    R = np.asarray(wTc, dtype=np.float64)[:3, :3]
    J = np.zeros((6, 6))
    J[:3, 3:] = J[3:, :3] = R
    turned = J @ np.asarray(covariance, dtype=np.float64).reshape(6, 6) @ J.T
    return np.asarray((turned + turned.T) / 2)


def ellipsoid(covariance: npt.ArrayLike) -> tuple[F64, F64]:
    """The 95 % ellipsoid of a position's covariance (3, 3), m².

    Returns its diameters (3,), metres, and the quaternion x, y, z, w (4,) of its axes.
    """
    variances, axes = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    diameters = 2 * ELLIPSOID_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    turned = poses.to_quaternion(poses.pose(axes, [0, 0, 0]))
    return np.maximum(diameters, _LEAST_M), turned
