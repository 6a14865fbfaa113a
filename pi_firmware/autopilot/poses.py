"""Which poses the autopilot gets, and when it is told that the estimate was reset."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pi_firmware.autopilot.frames import Mounting, VehiclePose, vehicle_pose
from pi_firmware.settings import AutopilotSettings
from pi_firmware.wire.messages import Pose

_SENT_STATES = ("TRACKING", "DEGRADED")
_FARTHEST_M = 10_000.0
_FASTEST = 100.0  # m/s and rad/s
_LARGEST_VARIANCE = 1e12  # MAVLink's numbers have single precision
_SPEED_M_S = 3.0  # no indoor blimp is faster; what moves farther has jumped
_TURN_DEG_S = 120.0
_FUTURE_NS = 100_000_000  # a capture time so far ahead is of another clock


@dataclass
class PoseCounts:
    """Poses so far: given to the autopilot, too old or out of order, not supported, not valid."""

    passed: int = 0
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
        x, y, z = settings.mount_m
        self._mounting = Mounting(
            roll_deg=settings.mount_roll_deg,
            pitch_deg=settings.mount_pitch_deg,
            yaw_deg=settings.mount_yaw_deg,
            position_m=(x, y, z),
            heading_deg=settings.world_heading_deg,
        )
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
        self.counts.passed += 1
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
