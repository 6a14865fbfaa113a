"""Where the next frame is expected: static, or constant velocity on SE(3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.localization.settings import MotionSettings


def constant_velocity(wTc_before: npt.ArrayLike, wTc_last: npt.ArrayLike, fraction: float) -> F64:
    """The pose (4, 4) a `fraction` of the last step after `wTc_last`.

    With equal steps, fraction 1, wT̂(k+1) = wT(k)·wT(k−1)⁻¹·wT(k): the step in the camera's own
    frame is made once more. Other fractions move along the same twist.
    """
    wTc_last = np.asarray(wTc_last, dtype=np.float64)
    step = poses.inverse(wTc_before) @ wTc_last
    if fraction != 1.0:
        step = poses.exp(fraction * poses.log(step))
    wTc = wTc_last @ step
    # Each product of products doubles the rounding error, and a solver keeps what it starts from:
    # unless it is made a rotation again, some fifty frames later it is none.
    return poses.from_quaternion(wTc[:3, 3], poses.to_quaternion(wTc))


class MotionModel:
    """The last two solved poses and what they predict, without covariance, as in the thesis.

    The setting `blimp` needs velocities and goes on at constant velocity here: see `process`.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.settings = settings
        self._last: tuple[int, F64] | None = None
        self._before: tuple[int, F64] | None = None

    def restart(self, time_ns: int, wTc: F64) -> None:
        """A pose from elsewhere, with no velocity: a given first one or a relocalization."""
        self._last, self._before = (time_ns, wTc), None

    def update(self, time_ns: int, wTc: F64) -> None:
        """A solved pose (4, 4), later than the last."""
        if self._last is None or time_ns <= self._last[0]:
            self.restart(time_ns, wTc)
        else:
            self._before, self._last = self._last, (time_ns, wTc)

    def predict(self, time_ns: int) -> F64 | None:
        """The expected pose (4, 4) at a time, or None when no pose was ever known.

        The velocity is that of the last two solved poses, whatever the time between them up to
        `max_step_s`. It is carried on for `coast_s`; after that the pose is held, because an
        unsupported velocity would leave the building.
        """
        if self._last is None:
            return None
        last_ns, wTc = self._last
        if self.settings.model == "static" or self._before is None:
            return wTc
        step_ns = last_ns - self._before[0]
        if step_ns > self.settings.max_step_s * 1e9:
            return wTc
        ahead_ns = min(time_ns - last_ns, self.settings.coast_s * 1e9)
        return constant_velocity(self._before[1], wTc, ahead_ns / step_ns)
