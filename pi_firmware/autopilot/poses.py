"""Which poses the autopilot gets, in its frames, and when it is told of a reset.

Its frames: world north-east-down, body forward-right-down. Ours: world z up, camera x right, y
down, z forward. The vehicle's pose is nTb; a covariance is of the right tangent wTc·exp(ξ),
rotation before translation, and becomes MAVLink's: x, y, z, roll, pitch, yaw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire.messages import Pose

Array = npt.NDArray[np.float64]

# A camera that looks ahead: the body's forward is its z, right its x, down its y.
_AHEAD = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_UPRIGHT = np.diag([1.0, -1.0, -1.0])  # z up to z down, about the x axis
_MIN_COSINE = 1e-2  # Euler angles have no covariance straight up or down


class Mounting:
    """How the camera sits in the vehicle, and the map in the world.

    `bRc` (3, 3) are the camera's axes in the body's, `offset_m` (3,) is its place there, `nRw`
    (3, 3) are the map's axes in north-east-down. The mount's angles turn a camera that looks ahead,
    in the body's axes and in the order yaw, pitch, roll: pitch -90 looks down.
    """

    def __init__(self, settings: AutopilotSettings) -> None:
        degrees = settings.mount_roll_deg, settings.mount_pitch_deg, settings.mount_yaw_deg
        self.bRc = rotation(*map(math.radians, degrees)) @ _AHEAD
        self.nRw = rotation(0.0, 0.0, math.radians(settings.world_heading_deg)) @ _UPRIGHT
        self.offset_m = np.array(settings.mount_m)


@dataclass(frozen=True)
class VehiclePose:
    """North, east, down (m) and roll, pitch, yaw (rad) of the vehicle.

    `covariance` (6, 6) is in this order; None where it is not known. `velocity_mps` and
    `turn_radps` are the vehicle's, along and about its own axes; None where they are not known.
    """

    position_m: Array
    angles_rad: Array
    covariance: Array | None
    velocity_mps: Array | None = None
    turn_radps: Array | None = None

    def quaternion_wxyz(self) -> list[float]:
        """Of nTb, from its angles."""
        c, s = np.cos(self.angles_rad / 2).tolist(), np.sin(self.angles_rad / 2).tolist()
        return [
            c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
            s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
            c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
            c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
        ]

    def upper_triangle(self) -> list[float]:
        """The 21 numbers of MAVLink, row by row; the first is NaN where it is not known."""
        if self.covariance is None:
            return [math.nan] + [0.0] * 20
        return [float(value) for value in self.covariance[np.triu_indices(6)]]


def vehicle_pose(
    position_m: Sequence[float],
    quaternion_xyzw: Sequence[float],
    covariance: Array | None,
    mounting: Mounting,
    velocity_mps: Sequence[float] | None = None,
    turn_radps: Sequence[float] | None = None,
) -> VehiclePose:
    """The vehicle's pose from the camera's: position and quaternion of wTc, its covariance (6, 6).

    `velocity_mps` is the camera's in the map's axes, `turn_radps` its turn about its own. Raises
    `ValueError` for a quaternion that is no rotation.
    """
    wRc = _matrix(quaternion_xyzw)
    bRc, nRw, offset = mounting.bRc, mounting.nRw, mounting.offset_m
    nRc = nRw @ wRc
    nRb = nRc @ bRc.T
    angles = _angles(nRb)
    if covariance is not None:
        roll, pitch = angles[0], angles[1]
        cosine = math.copysign(max(abs(math.cos(pitch)), _MIN_COSINE), math.cos(pitch))
        tangent = math.sin(pitch) / cosine
        # What a small turn of the body, in its own axes, does to roll, pitch and yaw.
        turn = np.array(
            [
                [1.0, math.sin(roll) * tangent, math.cos(roll) * tangent],
                [0.0, math.cos(roll), -math.sin(roll)],
                [0.0, math.sin(roll) / cosine, math.cos(roll) / cosine],
            ]
        )
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = nRb @ _skew(offset) @ bRc
        jacobian[:3, 3:] = nRc
        jacobian[3:, :3] = turn @ bRc
        covariance = jacobian @ covariance @ jacobian.T
    velocity = turned = None
    if velocity_mps is not None and turn_radps is not None:
        turned = bRc @ np.asarray(turn_radps, float)
        velocity = nRb.T @ nRw @ np.asarray(velocity_mps, float) - np.cross(turned, offset)
    position = nRw @ np.asarray(position_m, float) - nRb @ offset
    return VehiclePose(position, angles, covariance, velocity, turned)


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw)·Ry(pitch)·Rx(roll), (3, 3), angles in rad: the aerospace order."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _angles(aRb: Array) -> Array:
    roll = math.atan2(aRb[2, 1], aRb[2, 2])
    pitch = math.asin(min(max(-float(aRb[2, 0]), -1.0), 1.0))
    return np.array([roll, pitch, math.atan2(aRb[1, 0], aRb[0, 0])])


def _matrix(quaternion_xyzw: Sequence[float]) -> Array:
    norm = math.sqrt(sum(q * q for q in quaternion_xyzw))
    if not 0.99 < norm < 1.01:
        raise ValueError(f"a quaternion of length {norm:g} is no rotation")
    x, y, z, w = (q / norm for q in quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


_SENT_STATES = ("TRACKING", "DEGRADED")
_FARTHEST_M = 10_000.0
_FASTEST = 100.0  # m/s and rad/s
_LARGEST_VARIANCE = 1e12  # MAVLink's numbers have single precision
_SPEED_M_S = 3.0  # no indoor blimp is faster; what moves farther has jumped
_TURN_DEG_S = 120.0
_FUTURE_NS = 100_000_000  # a capture time so far ahead is of another clock


@dataclass
class PoseCounts:
    """Poses that were not given so far: too old or out of order, not supported, not valid."""

    stale: int = 0
    lost: int = 0
    refused: int = 0


class PoseGate:
    """Turns poses of the ground station into the vehicle's, those that may be flown by.

    `reset_counter` (0 to 255, then again) goes up when the estimate was relocalized, came back
    after it had been lost, or moved farther than a blimp can.
    """

    def __init__(self, settings: AutopilotSettings) -> None:
        self.counts = PoseCounts()
        self.reset_counter = 0
        self._settings = settings
        self._mounting = Mounting(settings)
        self._last: tuple[int, VehiclePose] | None = None
        self._interrupted = False

    def take(self, message: Pose, now_ns: int) -> VehiclePose | None:
        """The vehicle's pose, or None for one that must not be sent; `now_ns` is our clock's."""
        if message.state not in _SENT_STATES or message.position_m is None:
            self.counts.lost += 1
            self._interrupted |= message.state not in _SENT_STATES
            return None
        if not self.is_fresh(message.capture_ns, now_ns) or (
            self._last is not None and message.capture_ns <= self._last[0] <= now_ns
        ):
            self.counts.stale += 1
            return None
        pose = self._converted(message)
        if pose is None:
            self.counts.refused += 1
            return None
        if self._last is not None and (
            message.relocalized or self._interrupted or self._jumped(message.capture_ns, pose)
        ):
            self.reset_counter = (self.reset_counter + 1) % 256
        self._interrupted = False
        self._last = (message.capture_ns, pose)
        return pose

    def is_fresh(self, capture_ns: int, now_ns: int) -> bool:
        """Whether a pose taken then may still be sent."""
        return -_FUTURE_NS <= now_ns - capture_ns <= self._settings.max_age_s * 1e9

    def _converted(self, message: Pose) -> VehiclePose | None:
        position, quaternion = message.position_m, message.quaternion_xyzw
        if position is None or quaternion is None or (len(position), len(quaternion)) != (3, 4):
            return None
        if max(map(abs, position)) > _FARTHEST_M:
            return None
        motion = message.velocity_mps, message.turn_radps
        for values in motion:
            if values is not None and (len(values) != 3 or max(map(abs, values)) > _FASTEST):
                return None
        covariance = None
        if message.covariance:
            if len(message.covariance) != 36:
                return None
            covariance = np.array(message.covariance, float).reshape(6, 6)
            if np.diag(covariance).min() < 0 or np.abs(covariance).max() > _LARGEST_VARIANCE:
                return None
        try:
            return vehicle_pose(position, quaternion, covariance, self._mounting, *motion)
        except ValueError:
            return None

    def _jumped(self, capture_ns: int, pose: VehiclePose) -> bool:
        assert self._last is not None
        before_ns, before = self._last
        dt_s = abs(capture_ns - before_ns) / 1e9
        moved_m = float(np.linalg.norm(pose.position_m - before.position_m))
        yaw = float(pose.angles_rad[2] - before.angles_rad[2])
        turned_deg = abs(math.degrees(math.remainder(yaw, 2 * math.pi)))
        settings = self._settings
        return (
            moved_m > settings.jump_m + _SPEED_M_S * dt_s
            or turned_deg > settings.jump_deg + _TURN_DEG_S * dt_s
        )
