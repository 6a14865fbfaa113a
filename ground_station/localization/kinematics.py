"""Where the camera is and how it moves, with what is known of both: the state of the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.geometry import poses


@dataclass(frozen=True)
class Kinematics:
    """Pose and velocity at a time.

    `wTc` (4, 4); `twist` (6,) in the camera's axes, rotation (rad/s) before translation (m/s), so
    that wTc(t + dt) = wTc·exp(twist·dt); `covariance` (12, 12) of the right tangent of the pose
    (rotation, translation) and then of the twist.
    """

    time_ns: int
    wTc: F64
    twist: F64
    covariance: F64

    def after(self, dt_s: float) -> F64:
        """The pose (4, 4) `dt_s` later at the same twist."""
        return np.asarray(self.wTc @ poses.exp(self.twist * dt_s))


@dataclass(frozen=True)
class LandmarkObservations:
    """N landmarks seen in one frame.

    `points_m` (N, 3) in the world; `pinhole_px` (N, 2), undistorted pixels; `row_s` (N,), when each
    one's row was exposed after the frame's time (0 for a global shutter); `sigma_px` (N,), standard
    deviation of a pixel coordinate; `covariance_m2` (N, 3, 3) of the points' positions; `stretch`
    (N,), how many undistorted pixels one of the picture's is there, by which residuals are judged;
    `by_focal_m` (N, 3), how the points follow the map's focal length.
    """

    points_m: F64
    pinhole_px: F64
    row_s: F64
    sigma_px: F64
    covariance_m2: F64
    stretch: F64
    by_focal_m: F64

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True)
class Solution:
    """A pose and twist from a prediction and one frame's observations; `state` is None when it
    failed.

    `information` (12, 12) and `gradient` (12,) are of the observations alone, robustly weighted, at
    the solution: minus log-likelihood is ½ δᵀ·information·δ + gradientᵀ·δ for a tangent step δ of
    pose and twist. `innovation` is the squared Mahalanobis distance of the solution from the
    prediction by the prediction's covariance (12 degrees of freedom). `residual_px` (N,) and
    `inlier` (N,) belong to the observations given; `reason` says why there is no state.
    `pose_by_focal` (6, 2) is by how much the pose (right tangent) that the observations alone say
    follows the share by which the focal length is longer, the frame's and the map's; None by
    solvers that do not tell. `noise` is the variance of the observations, as their residuals show
    it, over the one that `information` weighs them with."""

    state: Kinematics | None
    information: F64
    gradient: F64
    residual_px: F64
    inlier: Bools
    innovation: float = float("nan")
    iterations: int = 0
    reason: str = ""
    pose_by_focal: F64 | None = None
    noise: float = 1.0


def no_solution(count: int, reason: str, iterations: int = 0) -> Solution:
    """A solution that is none, of `count` observations."""
    return Solution(
        None, np.zeros((12, 12)), np.zeros(12), np.full(count, np.inf), np.zeros(count, bool),
        iterations=iterations, reason=reason,
    )  # fmt: skip
