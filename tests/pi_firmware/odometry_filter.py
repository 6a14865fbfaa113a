"""What an autopilot makes of `ODOMETRY`: an extended Kalman filter without its inertial sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pi_firmware.autopilot.poses import rotation

_STEP = 1e-6


class OdometryFilter:
    """North, east, down (m), velocity along them (m/s) and roll, pitch, yaw (rad): `state` (9,).

    The velocity goes on as it was, and the vehicle keeps its attitude, but for what the deviations
    allow. Positions and angles are believed as the message says; its velocities, forward, right and
    down, by the filter's own figure, as ArduPilot and PX4 do where their variance is unknown.
    """

    VELOCITY_M_S = 0.1
    ACCELERATION_M_S2, TURN_RAD_S = 0.3, 0.4

    def __init__(self) -> None:
        self.state: np.ndarray | None = None
        self.covariance = np.eye(9)
        self._usec = 0

    def take(self, message: Any) -> float | None:
        """Takes a message; its squared innovation over its variance, of nine degrees, or None of
        the first one."""
        told = np.zeros((6, 6))
        told[np.triu_indices(6)] = message.pose_covariance
        noise = np.zeros((9, 9))
        noise[:6, :6] = told + np.triu(told, 1).T
        noise[6:, 6:] = np.eye(3) * self.VELOCITY_M_S**2
        place, angles = np.array([message.x, message.y, message.z]), _angles(message.q)
        seen = np.concatenate([place, angles, [message.vx, message.vy, message.vz]])
        if self.state is None:
            ahead = rotation(*angles) @ seen[6:]
            self.state, self._usec = np.concatenate([place, ahead, angles]), message.time_usec
            self.covariance = np.diag(np.repeat([0.1, 0.2, 0.1], 3) ** 2)
            return None
        dt_s, self._usec = (message.time_usec - self._usec) / 1e6, message.time_usec
        move = np.eye(9)
        move[:3, 3:6] = dt_s * np.eye(3)
        gain = np.concatenate([0.5 * dt_s**2 * np.eye(3), dt_s * np.eye(3)])
        grown = np.zeros((9, 9))
        grown[:6, :6] = gain @ gain.T * self.ACCELERATION_M_S2**2
        grown[6:, 6:] = np.eye(3) * (self.TURN_RAD_S * dt_s) ** 2
        self.state = move @ self.state
        self.covariance = move @ self.covariance @ move.T + grown
        expected = _seen(self.state)
        slopes = [(_seen(self.state + step) - expected) / _STEP for step in _STEP * np.eye(9)]
        jacobian = np.array(slopes).T
        missed = seen - expected
        missed[3:6] = np.remainder(missed[3:6] + math.pi, 2 * math.pi) - math.pi
        spread = jacobian @ self.covariance @ jacobian.T + noise
        weight = self.covariance @ jacobian.T @ np.linalg.inv(spread)
        self.state = self.state + weight @ missed
        self.covariance = (np.eye(9) - weight @ jacobian) @ self.covariance
        return float(missed @ np.linalg.solve(spread, missed))


def _seen(state: np.ndarray) -> np.ndarray:
    return np.concatenate([state[:3], state[6:], rotation(*state[6:]).T @ state[3:6]])


def _angles(wxyz: Any) -> np.ndarray:
    w, x, y, z = (float(part) for part in wxyz)
    return np.array([
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    ])  # fmt: skip
