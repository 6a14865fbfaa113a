"""What may be said of a frame: its covariance, its state and why it is not better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F32, F64
from ground_station.geometry.camera import Camera
from ground_station.localization.attempt import Attempt
from ground_station.localization.estimate import State
from ground_station.localization.kinematics import Solution
from ground_station.localization.relocalization import spread
from ground_station.localization.settings import CovarianceSettings, StateSettings
from ground_station.localization.verification import cells
from ground_station.map.uncertainty import Accuracy


def covariance_in_map(
    covariance: F64,
    solution: Solution,
    settings: CovarianceSettings,
    of_focal: F64,
    crowding: float = 1.0,
) -> F64:
    """The pose's covariance (6, 6) in the map: the filter's, scaled, and what it cannot know.

    A filter takes the errors of two frames for independent. A share of their variance is not: those
    of the landmarks that both see, and of the keyframe that both follow (of residuals of landmarks
    seen twice, a second apart, 0.46 to 0.76 is common in simulated flights). No number of frames
    makes it less than it is for one alone: the inverse of its information about the pose, times the
    noise that its residuals show and by their `crowding`: twice as many landmarks in the same parts
    of the picture tell no more of a map that is bent there.

    Nor does a filter know of focal lengths, the frames' and the map's, that are off by shares of
    the covariance `of_focal` (2, 2): the pose follows them as the `solution` says (considered, not
    estimated: Schmidt 1966)."""
    published = settings.scale**2 * (1 - settings.shared) * covariance[:6, :6]
    if settings.shared > 0:
        try:
            alone = crowding * solution.noise * np.linalg.inv(solution.information[:6, :6])
        except np.linalg.LinAlgError:
            return np.full((6, 6), np.inf)
        published = published + settings.shared * alone
    if of_focal.any() and solution.pose_by_focal is not None:
        published = published + solution.pose_by_focal @ of_focal @ solution.pose_by_focal.T
    return np.asarray(published)


def crowded(pixel_px: F32, camera: Camera) -> float:
    """How many of N pixels (N, 2) there are to a part of the picture that holds any.

    Of each of six simulated flights through the sample map 93 to 100 % of the poses lie inside
    their 95 % ellipsoid by this, with 600 points; 84 to 100 % where each of 300 counted.
    """
    return len(pixel_px) / max(1, len(np.unique(cells(pixel_px, camera.width_px), axis=0)))


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


@dataclass(frozen=True)
class Evidence:
    """What speaks for or against a solved frame.

    `inliers` of `observations`; `spread` of the inliers (RMS over the image's diagonal);
    `residual_px` the inliers' RMS; `covariance` (6, 6) of the pose in the map;
    `innovation` the squared Mahalanobis distance from the prediction, NaN without one; `support_ns`
    the time of the features it rests on: its keyframe's, or its own; `denied` how many frames since
    then were described and did not confirm it; `sharpness` against the frames before, 0 to 1.
    """

    inliers: int
    observations: int
    spread: float
    residual_px: float
    covariance: F64
    innovation: float = float("nan")
    support_ns: int = 0
    denied: int = 0
    sharpness: float = 1.0


class Judge:
    """The state machine. Down at once, up again only after several good frames in a row."""

    def __init__(self, settings: StateSettings) -> None:
        self.settings = settings
        self.state = State.INITIALIZING
        self.last_solved_ns: int | None = None
        """The time of the last frame that was solved."""
        self._good = 0
        self._owed = 0
        self._owed_for = ""
        self._doubtful_ns: int | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the pose rests on a relocalization that no other features confirmed."""
        return self._doubtful_ns is not None

    def found_again(self, time_ns: int, significance: float) -> None:
        """A frame was searched and found: others with features of their own must agree.

        Not so where its own features leave nothing to confirm.
        """
        sure = significance >= self.settings.sure_significance
        self._owe(0 if sure else self.settings.confirm_frames, "found again, to be confirmed")
        self._doubtful_ns = None if sure else time_ns

    def _owe(self, frames: int, why: str) -> None:
        """Before TRACKING so many good frames in a row are needed, `why` is said until then."""
        self._owed, self._owed_for, self._good = frames, why, 0

    def solved(self, time_ns: int, evidence: Evidence) -> tuple[State, str]:
        """The state of a solved frame, and what is wrong with it if it is not TRACKING."""
        self.last_solved_ns = time_ns
        fault = self._fault(time_ns, evidence)
        if fault:
            self._good = 0
            if self.state is State.TRACKING:
                self._owe(self.settings.recover_frames, "just recovered")
            self.state = State.DEGRADED
            return self.state, fault
        doubtful = self._doubtful_ns is not None and evidence.support_ns <= self._doubtful_ns
        self._good += not doubtful
        if doubtful or self._good < self._owed:
            self.state = State.DEGRADED
            return self.state, f"{self._owed_for}; {self._good} of {self._owed} frames agree"
        self._owed, self._doubtful_ns = 0, None
        self.state = State.TRACKING
        return self.state, ""

    def _fault(self, time_ns: int, seen: Evidence) -> str:
        s = self.settings
        if seen.inliers < s.good_inliers:
            return f"few inliers: {seen.inliers}"
        if seen.spread < s.good_spread:
            return f"poor spread: {seen.spread:.3f}"
        sigma_m = float(np.sqrt(np.trace(seen.covariance[3:, 3:])))
        sigma_deg = float(np.rad2deg(np.sqrt(np.trace(seen.covariance[:3, :3]))))
        if not sigma_m <= s.good_sigma_m:
            return f"uncertain position: {sigma_m:.2f} m"
        if not sigma_deg <= s.good_sigma_deg:
            return f"uncertain direction: {sigma_deg:.1f} deg"
        if seen.residual_px > s.good_residual_px:
            return f"high residual: {seen.residual_px:.1f} px"
        if seen.inliers < s.good_inlier_share * seen.observations:
            return f"few agree: {seen.inliers} of {seen.observations}"
        if seen.innovation > s.max_innovation:
            return f"jump: {np.sqrt(seen.innovation):.1f} sigma from the prediction"
        age_s = (time_ns - seen.support_ns) / 1e9
        # Age alone is no evidence: features that nobody had the time to look at deny nothing.
        if seen.denied and age_s > s.max_support_s:
            return f"stale keyframe: {age_s:.1f} s old, not confirmed by {seen.denied} since"
        if seen.sharpness < s.good_sharpness:
            return f"blur: {seen.sharpness:.2f} of the usual sharpness"
        return ""

    def unsolved(self, time_ns: int, patience_s: float | None = None) -> State:
        """The state of a frame without a pose of its own; DEGRADED for `patience_s`, then LOST."""
        self.state = self.after_gap(time_ns, patience_s)
        self._good = 0
        if self._owed == 0 and self.state is not State.INITIALIZING:
            self._owe(self.settings.recover_frames, "just recovered")
        return self.state

    def after_gap(self, time_ns: int, patience_s: float | None = None) -> State:
        """What an unsolved frame would leave behind; changes nothing."""
        if self.last_solved_ns is None:
            return State.INITIALIZING
        patience_s = self.settings.lost_after_s if patience_s is None else patience_s
        recent = time_ns - self.last_solved_ns <= patience_s * 1e9
        return State.DEGRADED if recent and self.state is not State.LOST else State.LOST
