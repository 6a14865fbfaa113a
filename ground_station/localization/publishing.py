"""What is said about a frame: evidence for the judge, and the estimate that goes out."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.localization.attempt import Attempt
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.localization.judge import Evidence
from ground_station.localization.kinematics import Kinematics, Solution
from ground_station.localization.relocalization import spread
from ground_station.localization.settings import CovarianceSettings
from ground_station.map.accuracy import Accuracy


def covariance_in_map(
    covariance: F64, solution: Solution, settings: CovarianceSettings, of_focal: F64
) -> F64:
    """The pose's covariance (6, 6) in the map: the filter's, scaled, and what it cannot know.

    A filter takes the errors of two frames for independent. A share of their variance is not: those
    of the landmarks that both see, and of the keyframe that both follow (of residuals of landmarks
    seen twice, a second apart, 0.46 to 0.76 is common in simulated flights). No number of frames
    makes it less than it is for one alone: the inverse of its information about the pose, times the
    noise that its residuals show.

    Nor does a filter know of focal lengths, the frames' and the map's, that are off by shares of
    the covariance `of_focal` (2, 2): the pose follows them as the `solution` says (considered, not
    estimated: Schmidt 1966)."""
    published = settings.scale**2 * (1 - settings.shared) * covariance[:6, :6]
    if settings.shared > 0:
        try:
            alone = solution.noise * np.linalg.inv(solution.information[:6, :6])
        except np.linalg.LinAlgError:
            return np.full((6, 6), np.inf)
        published = published + settings.shared * alone
    if of_focal.any() and solution.pose_by_focal is not None:
        published = published + solution.pose_by_focal @ of_focal @ solution.pose_by_focal.T
    return np.asarray(published)


def covariance_in_world(in_map: F64, of_map: Accuracy, wTc: F64, share: float) -> F64:
    """The pose's covariance (6, 6) as it goes out: in the map, and the map's own in the world.

    The first cannot know how the map is bent and how well it is registered, and the more images a
    map has, the smaller it is beside that. `share` is of the map's deviations.
    """
    return np.asarray(in_map + share**2 * of_map.at(wTc)) if share > 0 else in_map


def evidence_of(
    attempt: Attempt,
    solution: Solution,
    covariance: F64,
    camera: Camera,
    support_ns: int,
    denied: int,
) -> Evidence:
    """What speaks for a solved frame, whose observations the attempt holds.

    `covariance` (6, 6) is the one in the map, about which alone a localizer can do something.
    """
    seen = attempt.observations
    residual = solution.residual_px[solution.inlier]
    return Evidence(
        inliers=int(solution.inlier.sum()),
        observations=len(seen),
        spread=spread(seen.pixel_px[solution.inlier], camera),
        residual_px=float(np.sqrt(np.mean(residual**2))) if len(residual) else np.inf,
        covariance=covariance,
        innovation=solution.innovation,
        support_ns=support_ns,
        denied=denied,
        sharpness=attempt.taken.sharpness,
    )


def publish(
    attempt: Attempt,
    state: State,
    reason: str,
    *,
    found: Kinematics | None = None,
    covariance: F64 | None = None,
    relocalized: bool = False,
    gated: bool = False,
    tracked: bool = False,
) -> PoseEstimate:
    """The estimate of a frame that was `found`, or that has no pose."""
    return PoseEstimate(
        time_ns=attempt.time_ns,
        index=attempt.index,
        state=state,
        reason=reason,
        wTc=found.wTc if found else None,
        twist=found.twist if found else None,
        covariance=covariance,
        counts=attempt.counts,
        observations=attempt.observations,
        stage_ms=attempt.watch.finish(),
        gated=gated,
        relocalized=relocalized,
        tracked=tracked,
    )
