"""The localizer: its state lives here and nowhere else."""

from __future__ import annotations

from collections import deque
from functools import partial
from time import perf_counter

import numpy as np
import numpy.typing as npt

from ground_station.arrays import U8, Bools, Indices
from ground_station.errors import GroundStationError, InputError
from ground_station.features.extractor import Extractor, Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.resizing import misfit
from ground_station.localization import following, gate
from ground_station.localization.acquisition import Acquired, Acquirer, Located
from ground_station.localization.attempt import Attempt, Conditions
from ground_station.localization.blur import gradient_energy, sharpness
from ground_station.localization.estimate import Counts, PoseEstimate, State, no_observations
from ground_station.localization.estimator import Estimator, make_estimator
from ground_station.localization.following import Followed
from ground_station.localization.judge import (
    Judge,
    covariance_in_map,
    covariance_in_world,
    crowded,
    evidence_of,
)
from ground_station.localization.kinematics import Kinematics, Solution
from ground_station.localization.lens import against_map, considered
from ground_station.localization.matching import Described, Matcher, describe
from ground_station.localization.settings import LocalizerSettings, in_units
from ground_station.localization.tracking import Keyframe
from ground_station.localization.worker import Worker
from ground_station.map.store import Map, check_features
from ground_station.map.uncertainty import accuracy

_USUAL_DEPTH_M = 5.0
"""How far off the landmarks of a map without units are taken to be: it says how fast is fast."""
_FASTEST = 3.0
"""Standard deviations of the velocity that a camera may have."""
_URGENT = 0.5
"""Of the share of its points at which a keyframe is renewed: where it waits for no rest."""


class LocalizationError(GroundStationError):
    """A localizer that cannot be used as asked."""


class Localizer:
    """Frames in, poses out, against one map."""

    def __init__(
        self,
        map_: Map,
        camera: Camera,
        extractor: Extractor,
        settings: LocalizerSettings,
        *,
        smoothing: bool = False,
    ) -> None:
        """With `smoothing` the smoothed poses are kept for `smoothed` to give out: whoever asks for
        them here is to call it, or they fill the memory of a stream that lasts.

        Raises `MapError` when the map has other features, or says no numbers of its accuracy.
        """
        check_features(map_.info, extractor.name, extractor.sha256)
        self._accuracy = accuracy(map_.info)
        if not map_.info.registered and np.isfinite(map_.depth_m):
            settings = in_units(settings, map_.depth_m / _USUAL_DEPTH_M)
        self._smoothing = smoothing
        self.rest_s = 0.0
        """Raised by who must skip frames for lack of processor: a younger keyframe is then renewed
        only where it runs out, or where a pose waits for one to be confirmed, and where this is
        more than keyframes rest anyway, they carry a quarter of the points."""
        camera, is_maps = against_map(map_.info, camera)
        self._of_focal = considered(map_, is_maps, settings.covariance.focal)
        self.map, self.camera, self.extractor, self.settings = map_, camera, extractor, settings
        self._matcher = Matcher(map_, camera, settings, extractor.distance_scale)
        self._acquirer = Acquirer(map_, self._matcher, extractor, settings)
        self._worker: Worker[Acquired] = Worker(settings.tracking.features_lag_s)
        self.reset()

    def reset(self) -> None:
        """Forgets every frame, as when another stream begins."""
        self._worker.drop()
        self._judge = Judge(self.settings.state)
        self._estimator: Estimator = self._fresh()
        self._smoothed: list[Kinematics] = []
        self._keyframe: Keyframe | None = None
        self._denied = 0
        self._followed: Followed | None = None
        self._located: Located | None = None
        self._refused = ""
        self._since = following.Since()
        self._energies: deque[float] = deque(maxlen=self.settings.blur.recent_frames)
        self._seen: Indices | None = None
        self._last_frame_ns: int | None = None
        self._last_worked_ns: int | None = None
        self._last_search_ns: int | None = None
        self._idle_since_s = self._describing_s = 0.0

    @property
    def state(self) -> State:
        """The state after the last frame."""
        return self._judge.state

    @property
    def keyframe_late_s(self) -> float:
        """How long a frame's features have been under way, by the frames' time; 0: none are."""
        return 0.0 if self._last_frame_ns is None else self._worker.waiting_s(self._last_frame_ns)

    def set_initial_pose(self, wTc: npt.ArrayLike, time_ns: int) -> None:
        """A first pose (4, 4) from elsewhere: a prediction, so the frame is still solved itself.

        Raises `LocalizationError` when it is no rigid motion.
        """
        T = np.array(wTc, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise LocalizationError("initial pose: a finite 4x4 matrix is needed")
        if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(T) < 0:
            raise LocalizationError("initial pose: its rotation is not orthonormal")
        self._worker.drop()
        self._replace(self._fresh())
        self._estimator.restart(time_ns, T)
        self._keyframe, self._seen = None, None

    def smoothed(self) -> list[Kinematics]:
        """Poses that later frames helped to estimate, each once, some frames after its own.

        Never mixed with the causal ones that `process` returns; empty without `smoothing`, or
        without a smoother. Those of the last frames are not final before `finish`.
        """
        final, self._smoothed = self._smoothed + self._estimator.smoothed(), []
        return final

    def finish(self) -> list[Kinematics]:
        """`smoothed` and what is still open, at a stream's end; all frames are then forgotten."""
        final = self._smoothed + self._estimator.flush()
        self.reset()
        return final

    def process(
        self,
        time_ns: int,
        image: U8,
        index: int = 0,
        exposure_s: float | None = None,
        damaged: Bools | None = None,
    ) -> PoseEstimate:
        """The pose of a grey frame (H, W) uint8 taken at `time_ns`.

        `damaged` (rows, columns) are macroblocks of 16 px that show nothing of what was taken. Such
        a frame is followed and never searched: the rest of it may fit elsewhere, too.

        Raises `InputError` when its size is not the camera's. A frame that is not later than the
        one before is refused: its estimate says so and nothing else changes.
        """
        camera = self.camera
        if image.shape != (camera.height_px, camera.width_px):
            height, width = image.shape
            raise InputError(f"frame {index} has {misfit(camera, width, height)}")
        attempt = Attempt(time_ns, index)
        if (refused := self._refuse(attempt)) is not None:
            return refused
        entropy = gate.entropy_bits(image)
        attempt.watch.lap("entropy")
        self._last_frame_ns = time_ns
        state, motion = self.settings.state, self.settings.motion
        if reason := gate.low_entropy(entropy, self.settings.gate):
            # Skipped is not failed: until the prediction is no more than a held pose.
            patience_s = max(state.lost_after_s, motion.coast_s)
            return self._unsolved(attempt, reason, patience_s, gated=True)
        if reason := gate.low_contrast(image, self.settings.gate):
            return self._unsolved(attempt, reason, state.lost_after_s, gated=True)
        attempt.watch.lap("gate")
        attempt.taken = self._conditions(image, exposure_s, damaged)
        attempt.watch.lap("sharpness")
        unhurried, whole = self._unhurried(time_ns), damaged is None
        if whole or not unhurried:  # else the next whole frame is the one that is described
            self._last_worked_ns = time_ns
        if unhurried and whole:
            estimate = self._describe(attempt, image)
        else:
            estimate = self._follow(attempt, image)
            if whole:
                self._since.add(time_ns, image)
        self._idle_since_s = perf_counter()
        return estimate

    def process_features(self, time_ns: int, features: Features) -> PoseEstimate:
        """The same from features that were extracted elsewhere; nothing is gated or followed."""
        attempt = Attempt(time_ns)
        if (refused := self._refuse(attempt)) is not None:
            return refused
        self._last_frame_ns = self._last_worked_ns = time_ns
        return self._locate(attempt, describe(features, self.camera, self._conditions(None, None)))

    def _conditions(
        self, image: U8 | None, exposure_s: float | None, damaged: Bools | None = None
    ) -> Conditions:
        sharp = 1.0
        if image is not None and self.settings.blur.enabled:
            energy = gradient_energy(image)
            sharp = sharpness(energy, self._energies)
            self._energies.append(energy)
        return Conditions(exposure_s, sharp, self._seen, damaged)

    def _fresh(self) -> Estimator:
        return make_estimator(self.camera, self.settings, self._smoothing)

    def _replace(self, estimator: Estimator) -> None:
        self._smoothed += self._estimator.flush()
        self._estimator = estimator

    def _refuse(self, attempt: Attempt) -> PoseEstimate | None:
        last = self._last_frame_ns
        if last is None or attempt.time_ns > last:
            return None
        state = State.DEGRADED if self.state is State.TRACKING else self.state
        reason = f"refused: {(last - attempt.time_ns) / 1e9:.3f} s before the last frame"
        return attempt.estimate(state, reason)

    def _unhurried(self, time_ns: int) -> bool:
        """Whether there is time for a frame's own features.

        Skipped frames take none. Where nothing may wait there also was as much idle time before the
        frame as describing one took: frames that are far apart because others were dropped are no
        leisure.
        """
        last, tracking = self._last_worked_ns, self.settings.tracking
        if not tracking.enabled or last is None:
            return True
        if time_ns - last < tracking.describe_gap_s * 1e9:
            return False
        waiting = tracking.features_lag_s > 0
        return waiting or perf_counter() - self._idle_since_s >= self._describing_s

    # Frames that are described themselves

    def _describe(self, attempt: Attempt, image: U8) -> PoseEstimate:
        self._worker.drop()
        began_s = perf_counter()
        seen = self._acquirer.describe(image, attempt.taken)
        attempt.watch.lap("features")
        estimate = self._locate(attempt, seen)
        self._describing_s = perf_counter() - began_s
        if self.settings.tracking.enabled and estimate.wTc is not None and self._located:
            self._keyframe = self._acquirer.keyframe(
                attempt.time_ns, image, estimate.wTc, self._located
            )
            self._denied = 0
        return estimate

    def _locate(self, attempt: Attempt, seen: Described) -> PoseEstimate:
        attempt.predicted = self._estimator.predict(attempt.time_ns)
        expected = self._expected(attempt)
        found = self._acquirer.find(
            seen, attempt.time_ns, expected, self._estimator, self._fresh, attempt.watch
        )
        self._note(attempt, found)
        state = found.solution.state
        if state is None:
            return self._unsolved(attempt, found.solution.reason)
        if found.relocalized:
            sure = found.significance if self._within_speed(state, attempt) else 0.0
            self._begin_again(state, sure)
        elif found.wild:
            self._judge.found_again(attempt.time_ns, found.significance)
        return self._solved(attempt, found.solution, relocalized=found.relocalized, wild=found.wild)

    def _expected(self, attempt: Attempt) -> list[Kinematics]:
        """What is predicted of a frame, and the same of a camera that moves as nothing foretold."""
        wild = self._estimator.predict(attempt.time_ns, wild=True)
        return [state for state in (attempt.predicted, wild) if state is not None]

    def _note(self, attempt: Attempt, found: Located) -> None:
        attempt.counts = Counts(found.matches.projected, int(found.solution.inlier.sum()))
        attempt.observations = found.observations
        self._located = found

    def _gone(self, time_ns: int) -> bool:
        """Whether nothing is known any more that a frame could be looked for around."""
        return self._judge.after_gap(time_ns) in (State.INITIALIZING, State.LOST)

    def _may_search(self, time_ns: int) -> bool:
        """Whether the last search is long enough ago."""
        tried = self._last_search_ns
        return tried is None or time_ns - tried >= self.settings.recovery.interval_s * 1e9

    # Frames that are followed from a keyframe

    def _follow(self, attempt: Attempt, image: U8) -> PoseEstimate:
        relocalized = self._land(attempt)
        tracking, keyframe = self.settings.tracking, self._keyframe
        if keyframe is not None and self.rest_s > tracking.keyframe_interval_s:
            self._keyframe = keyframe.first(tracking.max_points // 4)
        attempt.predicted = self._estimator.predict(attempt.time_ns)
        reason = f"searching; last refused: {self._refused}" if self._refused else "searching"
        if self._keyframe is not None and attempt.predicted is not None:
            followed = following.follow(
                self._keyframe, attempt, image, attempt.predicted, self._matcher, self._estimator
            )
            self._followed = followed
            attempt.counts, attempt.observations = followed.counts, followed.observations
            if followed.solution.state is not None:
                estimate = self._solved(
                    attempt, followed.solution, followed=followed, relocalized=relocalized
                )
                self._renew(attempt, image, followed)
                return estimate
            reason = followed.solution.reason
        self._search(attempt, image)
        return self._unsolved(attempt, reason)

    def _renew(self, attempt: Attempt, image: U8, followed: Followed) -> None:
        """Asks for the next keyframe when this one is old, far or half out of view.

        One younger than `rest_s` must be worse than that: an old one costs some accuracy and no
        pose. A frame that shows but a part is none, as a whole one is soon to come.
        """
        if attempt.taken.damaged is not None:
            return
        settings, keyframe = self.settings.tracking, self._keyframe
        assert keyframe is not None and followed.solution.state is not None
        age_s = (attempt.time_ns - keyframe.time_ns) / 1e9
        due = age_s >= settings.keyframe_interval_s
        due |= followed.moved_px >= settings.keyframe_parallax_px
        share = attempt.counts.inliers / len(keyframe)
        due |= share < settings.keyframe_min_share
        urgent = self._judge.doubtful or share < _URGENT * settings.keyframe_min_share
        if not self._worker.busy and (urgent or (due and age_s >= self.rest_s)):
            time_ns, taken = attempt.time_ns, attempt.taken
            state = self._estimator.predict(time_ns) or followed.solution.state
            promote = self._acquirer.promote
            job = partial(promote, time_ns, image, state, self._estimator, taken)
            self._worker.submit(job, time_ns)

    def _search(self, attempt: Attempt, image: U8) -> None:
        """Asks for this frame to be found, near its prediction or anywhere."""
        whole = attempt.taken.damaged is None
        if self._worker.busy or not whole or not self._may_search(attempt.time_ns):
            return
        time_ns = self._last_search_ns = attempt.time_ns
        self._since.begin()
        expected = [] if self._gone(time_ns) else self._expected(attempt)
        search = self._acquirer.search
        job = partial(search, time_ns, image, expected, self._fresh, attempt.taken)
        self._worker.submit(job, time_ns)

    def _land(self, attempt: Attempt) -> bool:
        """Takes what the job beside the frames brings; whether it was found in the whole map."""
        landed = self._worker.collect(attempt.time_ns)
        if landed is None:
            return False
        attempt.watch.lap("wait")
        attempt.watch.stage_ms["background"] = landed.background_ms
        if landed.searched:
            self._refused = landed.reason if landed.keyframe is None else ""
        if landed.keyframe is None:
            self._denied += not landed.searched
            return False
        solved_ns = self._judge.last_solved_ns
        back = solved_ns is not None and solved_ns > landed.time_ns
        if not landed.searched or (back and not landed.relocalized):
            self._keyframe = following.better(landed.keyframe, self._keyframe, self._followed)
            self._denied = 0
            return False
        if back:
            return False  # tracking came back by itself while the whole map was searched
        estimator = self._fresh()
        since = self._since.after(landed.time_ns)
        caught_up = following.catch_up(landed, since, self._matcher, estimator)
        attempt.watch.lap("catch_up")
        if not caught_up:
            return False
        assert landed.state is not None
        sure = landed.found.significance if self._within_speed(landed.state, attempt) else 0.0
        self._replace(estimator)
        self._keyframe, self._denied = landed.keyframe, 0
        self._judge.found_again(landed.time_ns, sure)
        return landed.relocalized

    # What becomes of a frame

    def _within_speed(self, found: Kinematics, attempt: Attempt) -> bool:
        """Whether the camera can have come where it was found since a frame was solved.

        If not, one of the two poses is of a place that looks the same.
        """
        last_ns, expected = self._judge.last_solved_ns, self._estimator.predict(attempt.time_ns)
        if last_ns is None or expected is None:
            return True
        elapsed_s, start = (attempt.time_ns - last_ns) / 1e9, self.settings.start
        step = poses.log(poses.inverse(expected.after(-elapsed_s)) @ found.wTc)
        turn, way = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
        most_s = _FASTEST * elapsed_s
        return bool(
            way <= most_s * start.speed_m_s and np.rad2deg(turn) <= most_s * start.turn_deg_s
        )

    def _begin_again(self, state: Kinematics, significance: float) -> None:
        estimator = self._fresh()
        estimator.restart(state.time_ns, state.wTc, state.covariance[:6, :6])
        self._replace(estimator)
        self._keyframe = None
        self._judge.found_again(state.time_ns, significance)

    def _solved(
        self,
        attempt: Attempt,
        solution: Solution,
        *,
        relocalized: bool = False,
        wild: bool = False,
        followed: Followed | None = None,
    ) -> PoseEstimate:
        state = solution.state
        if not relocalized or followed:
            state = self._estimator.update(solution, wild)
        assert state is not None
        self._seen = attempt.observations.landmark[solution.inlier]
        settings = self.settings.covariance
        crowding = crowded(attempt.observations.pixel_px[solution.inlier], self.camera)
        in_map = covariance_in_map(state.covariance, solution, settings, self._of_focal, crowding)
        support_ns = followed.support_ns if followed else attempt.time_ns
        evidence = evidence_of(
            attempt, solution, in_map, self.camera, support_ns, self._denied if followed else 0
        )
        verdict, reason = self._judge.solved(attempt.time_ns, evidence)
        covariance = covariance_in_world(in_map, self._accuracy, state.wTc, settings.map)
        return attempt.estimate(
            verdict, reason, wTc=state.wTc, twist=state.twist, covariance=covariance,
            relocalized=relocalized, tracked=followed is not None,
        )  # fmt: skip

    def _unsolved(
        self, attempt: Attempt, reason: str, patience_s: float | None = None, gated: bool = False
    ) -> PoseEstimate:
        verdict = self._judge.unsolved(attempt.time_ns, patience_s)
        if verdict is State.LOST and self._keyframe is not None:
            # Found again by chance the keyframe would only repeat where the camera was.
            self._keyframe, self._followed, self._seen = None, None, None
            self._replace(self._fresh())
        attempt.observations = no_observations()
        return attempt.estimate(verdict, reason, gated=gated)
