"""The camera's true motion: a smooth function of time that pictures and ground truth share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64
from ground_station.geometry import poses

# Camera axes (x right, y down, z forward) in body axes (x forward, y left, z up).
_BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Mount:
    """How the camera sits on the body: metres from its turning point, degrees downwards."""

    forward_m: float = 0.12
    up_m: float = -0.42
    tilt_down_deg: float = 7.0

    @property
    def bTc(self) -> F64:
        """Camera to body coordinates, 4x4."""
        tilt = Rotation.from_euler("y", self.tilt_down_deg, degrees=True).as_matrix()
        return poses.pose(tilt @ _BODY_FROM_CAMERA, [self.forward_m, 0.0, self.up_m])


class Motion:
    """Poses of the camera by cubic splines through body positions and yaw, pitch, roll.

    With `is_held` it stands still at each of them, from halfway since the time before to halfway
    until the one after.

    `times_s` (N,), `position_m` (N, 3) world, `angles_rad` (N, 3) yaw (unwrapped), pitch (nose down
    positive), roll: R = Rz(yaw) Ry(pitch) Rx(roll).
    """

    def __init__(
        self,
        times_s: npt.NDArray[Any],
        position_m: npt.NDArray[Any],
        angles_rad: npt.NDArray[Any],
        mount: Mount,
        *,
        is_held: bool = False,
    ) -> None:
        self.start_s, self.end_s = float(times_s[0]), float(times_s[-1])
        states = np.hstack([position_m, angles_rad])
        self._spline: PPoly
        if is_held:
            between = (times_s[1:] + times_s[:-1]) / 2
            knots = np.concatenate([[times_s[0] - 1], between, [times_s[-1] + 1]])
            self._spline = PPoly(states[None], knots)
        else:
            self._spline = CubicSpline(times_s, states)
        self._rates = self._spline.derivative()
        self._bTc = mount.bTc

    def wTc(self, times_s: npt.ArrayLike) -> F64:
        """Poses (N, 4, 4) at times (N,), seconds."""
        states = self._spline(np.atleast_1d(np.asarray(times_s, dtype=np.float64)))
        R = Rotation.from_euler("ZYX", states[:, 3:]).as_matrix()
        return poses.pose(R, states[:, :3]) @ self._bTc

    def speed(self, times_s: npt.ArrayLike) -> tuple[F64, F64]:
        """Speed of the body, m/s, and the size of its angular rates, rad/s, at times (N,)."""
        rates = self._rates(np.atleast_1d(np.asarray(times_s, dtype=np.float64)))
        return np.linalg.norm(rates[:, :3], axis=1), np.linalg.norm(rates[:, 3:], axis=1)
