"""Frames solved from a keyframe's points, found again by KLT."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ground_station.arrays import U8
from ground_station.localization.acquisition import Acquired, believed
from ground_station.localization.attempt import Attempt
from ground_station.localization.estimate import Counts, Observations
from ground_station.localization.estimator import Estimator
from ground_station.localization.kinematics import Kinematics, Solution, no_solution
from ground_station.localization.matching import Matcher
from ground_station.localization.tracking import Keyframe, track

REMEMBERED = 12
"""Frames kept for catching up with a search's result: it may take 0.4 s at 30 Hz."""

_STEPS = 3
"""Frames of those in between that are solved on the way: KLT needs steps within its reach."""


@dataclass(frozen=True)
class Followed:
    """A frame solved from the keyframe's points.

    `moved_px` is the median way of the points since the keyframe, taken at `support_ns`.
    """

    solution: Solution
    counts: Counts
    observations: Observations
    moved_px: float
    support_ns: int


def follow(
    keyframe: Keyframe,
    attempt: Attempt,
    image: U8,
    predicted: Kinematics,
    matcher: Matcher,
    estimator: Estimator,
) -> Followed:
    """The keyframe's points in a frame (H, W), and the state that explains them."""
    settings = matcher.settings
    doubt_px = matcher.doubt_px(keyframe.points_m, predicted)
    tracks = track(
        keyframe, image, predicted.wTc, matcher.camera, settings.tracking, doubt_px, attempt.taken
    )
    attempt.watch.lap("track")
    found = len(tracks.point)
    landmark = keyframe.landmark[tracks.point]
    least = max(settings.tracking.min_inliers, settings.tracking.min_found_share * tracks.sought)
    if found < least:
        solution = no_solution(found, f"{found} points found again")
    else:
        observations = matcher.observations(
            tracks.pixel_px, landmark, keyframe.sigma_px[tracks.point], predicted, attempt.taken
        )
        few = replace(settings.pose, min_inliers=6)
        solution = estimator.solve(predicted, observations, few)
        solution = believed(solution, settings, int(np.ceil(least)))
    attempt.watch.lap("pose")
    way = np.linalg.norm(tracks.pixel_px - keyframe.pixel_px[tracks.point], axis=1)
    return Followed(
        solution,
        Counts(tracks.sought, int(solution.inlier.sum())),
        Observations(tracks.pixel_px, landmark, solution.residual_px, solution.inlier),
        float(np.median(way)) if found else 0.0,
        keyframe.time_ns,
    )


def better(landed: Keyframe, present: Keyframe | None, followed: Followed | None) -> Keyframe:
    """The new keyframe, unless it carries far fewer points than the present one still gives."""
    if present is None or followed is None:
        return landed
    return present if len(landed) < 0.5 * followed.counts.inliers else landed


def catch_up(
    landed: Acquired,
    recent: list[tuple[int, U8]],
    matcher: Matcher,
    estimator: Estimator,
) -> bool:
    """Brings a fresh estimator from a found frame through some of the frames since.

    False when its points cannot be followed that far.
    """
    assert landed.state is not None and landed.keyframe is not None
    estimator.restart(landed.time_ns, landed.state.wTc, landed.state.covariance[:6, :6])
    since = [frame for frame in recent if frame[0] > landed.time_ns]
    steps = np.linspace(0, max(len(since) - 1, 0), _STEPS + 1).astype(int)
    for step in np.unique(steps)[1:]:
        time_ns, image = since[step]
        predicted = estimator.predict(time_ns)
        assert predicted is not None
        found = follow(landed.keyframe, Attempt(time_ns, 0), image, predicted, matcher, estimator)
        if found.solution.state is None:
            return False
        estimator.update(found.solution)
    return True
