"""What takes longer than a frame: keyframes from features, and the way back when lost."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_station.arrays import F64, U8
from ground_station.features.extractor import Extractor
from ground_station.geometry import poses
from ground_station.localization import sweeping
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.estimate import Observations, no_observations
from ground_station.localization.estimator import Estimator
from ground_station.localization.kinematics import Kinematics, Solution, no_solution
from ground_station.localization.matching import (
    Described,
    Matcher,
    Matches,
    describe,
)
from ground_station.localization.relocalization import Relocalization, Relocalizer
from ground_station.localization.settings import LocalizerSettings
from ground_station.localization.tracking import Keyframe, spread_out
from ground_station.localization.verification import near_px
from ground_station.map.store import Map

_ALLOWED = 32.9
"""Squared Mahalanobis distance from a prediction: 99.9 % of twelve degrees of freedom."""
_NARROW = 0.1
"""Standard deviation of each axis of a prediction, in radians and in depths of the map."""
_CLOSER = 8
"""Solutions at most that are matched around once more. One draws the pose nearer by as much as it
looks around, 10 px of the 40 that a prediction may be off, or by less; most stay after one."""
_FOUND_RADIUS_PX = 15.0
"""Around a pose that was found in the whole map: it explains its inliers to a few pixels, and what
is left is the shear of a shutter whose motion nobody knows yet."""


@dataclass(frozen=True)
class Located:
    """A frame solved from features of its own, or why not.

    Observations are in the order of the matches. `relocalized`: found in the whole map, away from
    any prediction; `wild`: near one, but of a camera that moves as nothing foretold.
    `significance`: by how many standard deviations more landmarks are seen than by
    chance, and `excess`: the share of them; 0 where that was not asked.
    """

    solution: Solution
    matches: Matches
    observations: Observations
    relocalized: bool = False
    wild: bool = False
    significance: float = 0.0
    excess: float = 0.0


@dataclass(frozen=True)
class Acquired:
    """What a job beside the frames brings: a keyframe, or None and the reason.

    `searched`: the frame had no pose before.
    """

    time_ns: int
    keyframe: Keyframe | None
    found: Located
    searched: bool
    reason: str
    background_ms: float

    @property
    def state(self) -> Kinematics | None:
        """What the frame was found to be."""
        return self.found.solution.state

    @property
    def relocalized(self) -> bool:
        """Whether it was found in the whole map."""
        return self.found.relocalized


class Acquirer:
    """Solves frames from their own features. It keeps nothing of them: safe beside the tracking."""

    def __init__(
        self, map_: Map, matcher: Matcher, extractor: Extractor, settings: LocalizerSettings
    ) -> None:
        self.matcher, self._extractor, self._settings = matcher, extractor, settings
        self._landmarks, self._depth_m = map_.landmarks, map_.depth_m
        recovery = settings.recovery
        self._relocalizer: Relocalizer | None = None
        if recovery.relocalize:
            self._relocalizer = Relocalizer(
                map_, matcher.camera, recovery, settings.seed, matcher.scale,
                settings.start.turn_deg_s,
            )  # fmt: skip

    def describe(self, image: U8, taken: Conditions) -> Described:
        """The features of a grey frame (H, W)."""
        return describe(self._extractor.extract(image), self.matcher.camera, taken)

    def locate(
        self,
        seen: Described,
        expected: Kinematics,
        estimator: Estimator,
        watch: Stopwatch,
        radius_px: float | None = None,
        around: Kinematics | None = None,
    ) -> Located:
        """Matches around a prediction and solves; closer again, if the settings say, till it stays.

        Without a radius it follows the prediction's covariance. It may be first matched `around`
        another state.
        """
        found = self._locate_once(seen, around or expected, expected, estimator, radius_px, watch)
        closer_px = self._settings.association.refine_radius_px
        for _ in range(_CLOSER):
            state = found.solution.state
            if state is None or closer_px == 0:
                break
            found = self._locate_once(seen, state, expected, estimator, closer_px, watch)
            after = found.solution.state
            if (
                after is None
                or self.matcher.reach_px(poses.log(poses.inverse(state.wTc) @ after.wTc))
                < self._settings.pose.sigma_px
            ):
                break
        held = self._held_by_near(seen, found, expected, estimator, watch)
        watch.lap("verification")
        return held

    def _held_by_near(
        self,
        seen: Described,
        found: Located,
        expected: Kinematics,
        estimator: Estimator,
        watch: Stopwatch,
    ) -> Located:
        """What was found; or, where far landmarks leave it open and near ones are not seen from
        it, the pose along what is open from which they are. Where another one shows more of them,
        but too few to be believed, the solution of the far ones, which is as open as they are.
        """
        state = found.solution.state
        if state is None or self._settings.pose.solver != "rolling":
            return found
        depth = self.matcher.depth(state.wTc, found.matches.landmark)
        median = float(np.median(depth))
        near = sweeping.NEAR * median
        kept = found.matches.where(depth >= sweeping.FAR * median)
        far = self._solve(seen, kept, expected, estimator)
        other = far.solution.state
        if other is None or not sweeping.opens(state.covariance, other.covariance, near):
            return found
        support = self.matcher.support(seen, state.wTc, near)
        # Each landmark adds one deviation at most: of too few nothing can be told.
        if support.significance >= sweeping.SURE or support.expected < sweeping.SURE:
            return found
        step = sweeping.weakest(other.covariance[:6, :6], median)
        moved_px = float(self.matcher.camera.fx_px * np.linalg.norm(step[3:]) / near)
        swept = sweeping.along(other.wTc, step, moved_px, near_px(self.matcher.camera))
        here, *held = self.matcher.counts(seen, [state.wTc, *swept], near)
        if max(held) - here <= sweeping.MORE * np.sqrt(max(held)):
            return found
        best, most = far, 0.0
        for k in np.argsort(held)[::-1][: sweeping.TRIED].tolist():
            around = replace(other, wTc=swept[k])
            again = self._locate_once(seen, around, expected, estimator, _FOUND_RADIUS_PX, watch)
            if again.solution.state is not None:
                sure = self.matcher.support(seen, again.solution.state.wTc, near).significance
                if sure >= sweeping.SURE and sure > most:
                    best, most = again, sure
        return best

    def find(
        self,
        seen: Described,
        time_ns: int,
        expected: Sequence[Kinematics],
        estimator: Estimator,
        make: Callable[[], Estimator],
        watch: Stopwatch,
    ) -> Located:
        """The frame near its prediction, or else anywhere in the map.

        What is found near is held against what is found anywhere where so few landmarks speak for
        it that they would not do so alone: around a prediction that is degrees off neighbours
        agree with each other, too, and a frame must not be the worse for having been predicted.

        `expected` are the predictions, the surest first; none before a start. Where one of them
        allows what was found anywhere, it is solved with that prediction: only its velocity tells a
        rolling shutter's shear from another place. Else it is solved with an estimator of `make`,
        which knows of nothing else.
        """
        if self._relocalizer is None:
            if not expected:
                return _nothing("no first pose")
            return self.locate(seen, expected[0], estimator, watch)
        near = _nothing("not looked for near")
        if expected and self.matcher.within_reach(expected[0]):
            near = self._verified(seen, self.locate(seen, expected[0], estimator, watch), watch)
            if near.excess >= self._settings.recovery.min_excess:
                return near

        def unless_near(found: Located) -> Located:
            """What is found anywhere, or near where more speaks for that."""
            lesser = found.solution.state is None or found.significance <= near.significance
            return near if lesser and near.solution.state is not None else found

        candidates = self._relocalizer.candidates(seen)
        watch.lap("relocalization")
        if isinstance(candidates, str):
            return unless_near(_nothing(candidates))
        for prediction, found in itertools.product(expected, candidates):
            if found.doubt and not (prediction is expected[0] and self._narrow(prediction)):
                continue
            located = self._agreed(seen, found, prediction, estimator, watch)
            if located is not None:
                wild = prediction is not expected[0]
                located = replace(located, wild=wild, significance=found.significance)
                return unless_near(located)
        sole = self._relocalizer.alone(candidates)
        if isinstance(sole, str):
            return unless_near(_nothing(sole))
        estimator = make()
        estimator.restart(time_ns, sole.wTc, self._open(sole))
        alone = estimator.predict(time_ns)
        assert alone is not None
        seen = seen.showing(sole.landmark)
        located = self.locate(seen, alone, estimator, watch, _FOUND_RADIUS_PX)
        return unless_near(replace(located, relocalized=True, significance=sole.significance))

    def _narrow(self, expected: Kinematics) -> bool:
        """Whether a prediction says where the camera is, so that a doubtful find it allows counts.

        A pose drawn by chance lies so near to it once in thousands.
        """
        sigma = np.sqrt(np.diag(expected.covariance)[:6]) / np.repeat([1.0, self._depth_m], 3)
        return bool(sigma.max() < _NARROW)

    def _open(self, found: Relocalization) -> F64:
        """The covariance (6, 6) of a find: before a wall a turn is hard to tell from a step aside,
        so that a direction which is open leaves a place open by as much of the depth."""
        depth_m = poses.transform(
            poses.inverse(found.wTc), self._landmarks.position_m[found.landmark]
        )
        angle = np.deg2rad(self._settings.start.sigma_deg)
        return np.diag(np.repeat([angle, angle * float(np.median(depth_m[:, 2]))], 3) ** 2)

    def _agreed(
        self,
        seen: Described,
        found: Relocalization,
        expected: Kinematics,
        estimator: Estimator,
        watch: Stopwatch,
    ) -> Located | None:
        """A find solved with a prediction, or None where that does not allow it.

        Asked of its matches and not of its pose, which takes a rolling shutter for a global one.
        """
        settings = self._settings.pose
        pixel = seen.features.keypoints_px[found.feature]
        observations = self.matcher.observations(
            pixel, found.landmark, settings.sigma_px, expected, seen.taken
        )
        solution = believed(estimator.solve(expected, observations, settings), self._settings)
        if solution.state is None or not solution.innovation < _ALLOWED:
            return None
        seen = seen.showing(found.landmark)
        located = self.locate(seen, expected, estimator, watch, _FOUND_RADIUS_PX, solution.state)
        return None if located.solution.state is None else located

    def keyframe(self, time_ns: int, image: U8, wTc: F64, found: Located) -> Keyframe:
        """The inliers of a frame at `wTc` (4, 4), thinned evenly, to be followed.

        Those of another descriptor are less trusted: the error of a match grows with its
        descriptors' distance (measured; landmarks seen in another light, or their neighbours).
        """
        settings, seen = self._settings.tracking, found.observations
        inlier = np.flatnonzero(seen.inlier)
        distance = found.matches.distance[inlier]
        inlier = inlier[np.argsort(distance, kind="stable")]
        inlier = inlier[spread_out(seen.pixel_px[inlier], settings.max_points)]
        pixel, landmark = seen.pixel_px[inlier], seen.landmark[inlier]
        points = np.asarray(self._landmarks.position_m[landmark], np.float64)
        ratio = found.matches.distance[inlier].astype(np.float64) / settings.doubt_distance
        sigma = settings.sigma_px * np.maximum(1.0, ratio) ** 2
        return Keyframe(time_ns, image, wTc, pixel, landmark, points, sigma)

    def promote(
        self,
        time_ns: int,
        image: U8,
        state: Kinematics,
        estimator: Estimator,
        taken: Conditions,
    ) -> Acquired:
        """Makes a tracked frame of a known state the next keyframe."""
        watch = Stopwatch()
        seen = self.describe(image, taken)
        radius_px = self._settings.association.refine_radius_px or self.matcher.radius_px
        share = self._settings.tracking.max_chance_share
        found = self._locate_once(seen, state, state, estimator, radius_px, watch, share)
        found = self._verified(seen, found, watch)
        return self._acquired(time_ns, image, found, watch, searched=False)

    def search(
        self,
        time_ns: int,
        image: U8,
        expected: Sequence[Kinematics],
        make: Callable[[], Estimator],
        taken: Conditions,
    ) -> Acquired:
        """Finds a frame near its prediction, or else anywhere."""
        watch = Stopwatch()
        seen = self.describe(image, taken)
        found = self.find(seen, time_ns, expected, make(), make, watch)
        return self._acquired(time_ns, image, found, watch, searched=True)

    def _verified(self, seen: Described, found: Located, watch: Stopwatch) -> Located:
        """What was found, or nothing when the frame shows too little of what it should."""
        state, least = found.solution.state, self._settings.tracking.min_significance
        if state is None:
            return found
        support = self.matcher.support(seen, state.wTc)
        watch.lap("verification")
        sure = support.significance
        if sure >= least:
            return replace(found, significance=sure, excess=support.share - support.chance)
        reason = f"only {sure:.1f} sigma more landmarks than by chance"
        return _nothing(reason)

    def _acquired(
        self, time_ns: int, image: U8, found: Located, watch: Stopwatch, *, searched: bool
    ) -> Acquired:
        keyframe, state = None, found.solution.state
        reason, count = found.solution.reason, int(found.observations.inlier.sum())
        if state is not None:
            if count >= self._settings.tracking.keyframe_min_points:
                keyframe = self.keyframe(time_ns, image, state.wTc, found)
            else:
                reason = f"{count} inliers"
        spent_ms = watch.finish()["total"]
        return Acquired(time_ns, keyframe, found, searched, reason, spent_ms)

    def _locate_once(
        self,
        seen: Described,
        around: Kinematics,
        expected: Kinematics,
        estimator: Estimator,
        radius_px: float | None,
        watch: Stopwatch,
        chance_share: float | None = None,
    ) -> Located:
        matches = self.matcher.match(seen, around, radius_px, watch, chance_share)
        located = self._solve(seen, matches, expected, estimator, around)
        watch.lap("pose")
        return located

    def _solve(
        self,
        seen: Described,
        matches: Matches,
        expected: Kinematics,
        estimator: Estimator,
        around: Kinematics | None = None,
    ) -> Located:
        """Solves with these matches; they were found `around` another state, where one is given."""
        settings = self._settings.pose
        around = around or expected
        pixel = seen.features.keypoints_px[matches.feature]
        if len(matches) < settings.min_observations:
            solution = no_solution(len(matches), f"{len(matches)} observations")
        else:
            seen_at = self.matcher.observations(
                pixel, matches.landmark, settings.sigma_px, around, seen.taken
            )
            solution = believed(estimator.solve(expected, seen_at, settings), self._settings)
        observations = Observations(pixel, matches.landmark, solution.residual_px, solution.inlier)
        return Located(solution, matches, observations)


def believed(solution: Solution, settings: LocalizerSettings, least: int | None = None) -> Solution:
    """The solution, or none when too few of its own observations agree with it.

    `least` inliers, instead of those that a described frame needs.
    """
    pose, total = settings.pose, len(solution.inlier)
    least = pose.min_inliers if least is None else least
    inliers = int(solution.inlier.sum())
    if solution.state is None or inliers >= max(least, pose.min_inlier_share * total):
        return solution
    return no_solution(total, f"{inliers} inliers of {total} observations", solution.iterations)


def _nothing(reason: str) -> Located:
    none = np.empty(0, np.intp)
    matches = Matches(none, none, np.empty(0, np.float32), 0)
    return Located(no_solution(0, reason), matches, no_observations())
