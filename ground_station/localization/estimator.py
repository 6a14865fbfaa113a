"""From observations to the state: as the thesis does it, or as a filter with covariance."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.kinematics import Kinematics, LandmarkObservations, Solution
from ground_station.localization.pose_alone import solve_graph
from ground_station.localization.pose_rolling import solve_rolling
from ground_station.localization.settings import LocalizerSettings, PoseSettings
from ground_station.localization.smoother import FixedLagSmoother


def constant_velocity(wTc_before: npt.ArrayLike, wTc_last: npt.ArrayLike, fraction: float) -> F64:
    """The pose (4, 4) a `fraction` of the last step after `wTc_last`.

    With equal steps, fraction 1, wT̂(k+1) = wT(k)·wT(k−1)⁻¹·wT(k): the step in the camera's own
    frame is made once more. Other fractions move along the same twist.
    """
    wTc = poses.interpolate(wTc_before, wTc_last, 1 + fraction)
    # Each product of products doubles the rounding error, and a solver keeps what it starts from:
    # unless it is made a rotation again, some fifty frames later it is none.
    return poses.from_quaternion(wTc[:3, 3], poses.to_quaternion(wTc))


class Estimator(Protocol):
    """What the localizer believes about the camera between two frames."""

    def restart(self, time_ns: int, wTc: F64, covariance: F64 | None = None) -> None:
        """A pose (4, 4) from elsewhere with its covariance (6, 6), and no known velocity."""
        ...

    def predict(self, time_ns: int, wild: bool = False) -> Kinematics | None:
        """What is expected at a time; None when no pose was ever known.

        `wild`: of a camera that moves as nothing foretold.
        """
        ...

    def solve(
        self, predicted: Kinematics, observations: LandmarkObservations, settings: PoseSettings
    ) -> Solution:
        """The state that explains the observations; changes nothing."""
        ...

    def update(self, solution: Solution, wild: bool = False) -> Kinematics:
        """Takes a solution for true and returns what is then believed of its time.

        `wild`: it is one of the wild prediction.
        """
        ...

    def smoothed(self) -> list[Kinematics]:
        """States that later frames helped to estimate, each once, when they are final."""
        return []

    def flush(self) -> list[Kinematics]:
        """`smoothed` and the states that no later frame will help; all is then forgotten."""
        return []


class PoseEstimator(Estimator):
    """Each frame's pose from that frame alone; the last two poses predict the next (thesis).

    Nothing is known of how good a prediction is. The setting `blimp` needs velocities and goes on
    at constant velocity here: see `process`.
    """

    def __init__(self, camera: Camera, settings: LocalizerSettings) -> None:
        self._camera, self._motion = camera, settings.motion
        self._last: tuple[int, F64] | None = None
        self._before: tuple[int, F64] | None = None

    def restart(self, time_ns: int, wTc: F64, covariance: F64 | None = None) -> None:
        self._last, self._before = (time_ns, wTc), None

    def predict(self, time_ns: int, wild: bool = False) -> Kinematics | None:
        """The velocity is that of the last two poses, whatever the time between them up to
        `max_step_s`. It is carried on for `coast_s`; after that the pose is held, because an
        unsupported velocity would leave the building.
        """
        if self._last is None:
            return None
        last_ns, wTc = self._last
        if self._before is not None and self._motion.model != "static":
            before_ns, before = self._before
            step_ns = last_ns - before_ns
            if step_ns <= self._motion.max_step_s * 1e9:
                ahead_ns = min(time_ns - last_ns, self._motion.coast_s * 1e9)
                wTc = constant_velocity(before, wTc, ahead_ns / step_ns)
        return Kinematics(time_ns, wTc, np.zeros(6), _UNKNOWN)

    def solve(
        self, predicted: Kinematics, observations: LandmarkObservations, settings: PoseSettings
    ) -> Solution:
        if len(observations):
            settings = dataclasses.replace(settings, sigma_px=float(observations.sigma_px.mean()))
        return solve_graph(predicted, observations, self._camera, settings)

    def update(self, solution: Solution, wild: bool = False) -> Kinematics:
        state = solution.state
        assert state is not None
        later = self._last is not None and state.time_ns > self._last[0]
        self._before = self._last if later else None
        self._last = state.time_ns, state.wTc
        return state


_UNKNOWN = np.full((12, 12), np.nan)


class FilterEstimator(FixedLagSmoother):
    """Pose and velocity from prediction and observations together, rows at their own times."""

    def __init__(
        self, camera: Camera, settings: LocalizerSettings, smoothing: bool = False
    ) -> None:
        super().__init__(settings.motion, keep=smoothing)
        self._camera, self._from = camera, settings.start

    def restart(self, time_ns: int, wTc: F64, covariance: F64 | None = None) -> None:
        start = self._from
        sigma = np.r_[
            np.full(3, np.deg2rad(start.sigma_deg)), np.full(3, start.sigma_m),
            np.full(3, np.deg2rad(start.turn_deg_s)), np.full(3, start.speed_m_s),
        ]  # fmt: skip
        full = np.diag(sigma**2)
        if covariance is not None:
            full[:6, :6] = covariance
        self.begin(Kinematics(time_ns, wTc, np.zeros(6), full))

    def solve(
        self, predicted: Kinematics, observations: LandmarkObservations, settings: PoseSettings
    ) -> Solution:
        return solve_rolling(predicted, observations, self._camera, settings)


def make_estimator(
    camera: Camera, settings: LocalizerSettings, smoothing: bool = False
) -> Estimator:
    """The one that `pose.solver` names; with `smoothing` it keeps smoothed states to give."""
    if settings.pose.solver == "rolling":
        return FilterEstimator(camera, settings, smoothing)
    return PoseEstimator(camera, settings)
