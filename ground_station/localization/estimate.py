"""What a localizer says about one frame."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np

from ground_station.arrays import F32, F64, Bools, Indices


class State(enum.Enum):
    """How far a pose can be trusted."""

    INITIALIZING = "INITIALIZING"
    """No frame was ever solved."""
    TRACKING = "TRACKING"
    """This frame was solved, and well supported."""
    DEGRADED = "DEGRADED"
    """Solved with little support, or not solved a moment after one that was; `reason` says why."""
    LOST = "LOST"
    """Not solved, and too long since the last one that was."""


@dataclass(frozen=True)
class Counts:
    """Landmarks projected into the frame, of a tracked one points expected in view; inliers of the
    pose."""

    projected: int = 0
    inliers: int = 0


@dataclass(frozen=True)
class Observations:
    """The N pairs a pose was solved from.

    `pixel_px` (N, 2), the features in the (distorted) image; `landmark` (N,), indices into the
    map's landmarks; `residual_px` (N,), at the solution; `inlier` (N,).
    """

    pixel_px: F32
    landmark: Indices
    residual_px: F64
    inlier: Bools

    def __len__(self) -> int:
        return len(self.landmark)


def no_observations() -> Observations:
    """Those of a frame that was not solved."""
    return Observations(
        np.empty((0, 2), np.float32), np.empty(0, np.intp), np.empty(0), np.empty(0, bool)
    )


@dataclass(frozen=True)
class PoseEstimate:
    """One frame's pose, or why there is none.

    `wTc` (4, 4) is only there when the frame was solved from its own observations. `twist` (6,) is
    the velocity in the camera's axes, rotation (rad/s) before translation (m/s); zero where the
    preset does not estimate it. `covariance` (6, 6) is of the right tangent wTc·exp(ξ) in the
    camera's axes, rotation (rad) before translation (m), as of GTSAM's Pose3. `stage_ms`
    has entropy, track, features, projection, association, pose, relocalization, wait, catch_up and
    total, those that ran; a keyframe's features landed in a frame with `background`, the time they
    took beside the frames, which is no part of the total. `tracked`: solved from a keyframe's
    points found again in this frame, and not from features of its own.
    """

    time_ns: int
    index: int
    state: State
    reason: str = ""
    wTc: F64 | None = None
    twist: F64 | None = None
    covariance: F64 | None = None
    counts: Counts = Counts()
    observations: Observations = field(default_factory=no_observations)
    stage_ms: dict[str, float] = field(default_factory=dict)
    gated: bool = False
    relocalized: bool = False
    tracked: bool = False

    @property
    def localized(self) -> bool:
        """Whether the frame was solved from its own observations."""
        return self.wTc is not None
