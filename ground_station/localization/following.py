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

_REMEMBERED = 32
"""Frames kept at most for catching up with a search's result."""
_STEPS, _STEP_S = 3, 0.25
"""Of the frames in between so many are solved on the way, or one each so many seconds where these
are more: KLT needs steps within its reach (in the sample's flight 0.14, 0.28 and 0.5 s serve alike,
as the velocity is known after the first; a faster camera wants them short)."""


class Since:
    """Frames since a search began, at most so many: the longer it takes, the farther apart.

    A search that takes 0.1 s on one computer takes three seconds on another, or on a busy one.
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forgets all frames."""
        self._kept: list[tuple[int, U8]] = []
        self._last: tuple[int, U8] | None = None
        self._stride, self._count = 1, 0

    def add(self, time_ns: int, image: U8) -> None:
        """Remembers a frame (H, W), the next in time."""
        self._last = (time_ns, image)
        if self._count % self._stride == 0:
            self._kept.append(self._last)
        self._count += 1
        if len(self._kept) == _REMEMBERED:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def after(self, time_ns: int) -> list[tuple[int, U8]]:
        """Those later than a time, the last of all among them."""
        last = [self._last] if self._last is not None and self._last is not self._kept[-1] else []
        return [frame for frame in self._kept + last if frame[0] > time_ns]


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
    since: list[tuple[int, U8]],
    matcher: Matcher,
    estimator: Estimator,
) -> bool:
    """Brings a fresh estimator from a found frame through some of the frames `since`, in order.

    False when its points cannot be followed that far.
    """
    assert landed.state is not None and landed.keyframe is not None
    estimator.restart(landed.time_ns, landed.state.wTc, landed.state.covariance[:6, :6])
    span_s = (since[-1][0] - landed.time_ns) / 1e9 if since else 0.0
    count = max(_STEPS, int(np.ceil(span_s / _STEP_S)))
    steps = np.linspace(0, max(len(since) - 1, 0), count + 1).astype(int)
    for step in np.unique(steps)[1:]:
        time_ns, image = since[step]
        predicted = estimator.predict(time_ns)
        assert predicted is not None
        found = follow(landed.keyframe, Attempt(time_ns, 0), image, predicted, matcher, estimator)
        if found.solution.state is None:
            return False
        estimator.update(found.solution)
    return True
