"""The localizer: its state lives here and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ground_station.errors import GroundStationError, InputError
from ground_station.features.extractor import Extractor, Features
from ground_station.geometry.camera import Camera
from ground_station.localization.association import associate
from ground_station.localization.attempt import Attempt, Stopwatch
from ground_station.localization.estimate import (
    Counts,
    Observations,
    PoseEstimate,
    State,
    no_observations,
)
from ground_station.localization.motion import MotionModel
from ground_station.localization.pose_direct import solve_direct
from ground_station.localization.pose_graph import PoseSolution, failure, solve_graph
from ground_station.localization.projection import Lens, project
from ground_station.localization.relocalization import Relocalizer, spread
from ground_station.localization.settings import LocalizerSettings
from ground_station.localization.tracking import Keyframe, spread_out, track
from ground_station.localization.visibility import LandmarkIndex
from ground_station.localization.worker import Worker
from ground_station.mapping.store import Map, check_features
from pi_firmware.wire.entropy import entropy_bits

Array = npt.NDArray[np.float64]

_SOLVERS = {"graph": solve_graph, "direct": solve_direct}


class LocalizationError(GroundStationError):
    """A localizer that cannot be used as asked."""


@dataclasses.dataclass(frozen=True)
class _Described:
    """A keyframe made beside the frames, or None when its features did not fit, and its time."""

    keyframe: Keyframe | None
    background_ms: float


class Localizer:
    """Frames in, poses out, against one map."""

    def __init__(
        self, map_: Map, camera: Camera, extractor: Extractor, settings: LocalizerSettings
    ) -> None:
        """Raises `MapError` when the map was built with other features than the extractor's."""
        check_features(map_.info, extractor.name, extractor.sha256)
        self.map, self.camera, self.extractor, self.settings = map_, camera, extractor, settings
        self._lens = Lens(camera)
        self._index = LandmarkIndex(map_.landmarks)
        recovery = settings.recovery
        self._relocalizer = (
            Relocalizer(map_, camera, recovery, settings.seed) if recovery.relocalize else None
        )
        self._solve = _SOLVERS[settings.pose.solver]
        self._tracked_pose = dataclasses.replace(
            settings.pose, sigma_px=settings.tracking.sigma_px, min_inliers=6
        )
        self._worker: Worker[_Described] = Worker(settings.tracking.features_lag_frames)
        self.reset()

    def reset(self) -> None:
        """Forgets every frame, as when another stream begins."""
        self.state = State.INITIALIZING
        self._motion = MotionModel(self.settings.motion)
        self._last_frame_ns: int | None = None
        self._last_solved_ns: int | None = None
        self._last_relocalization_ns: int | None = None
        self._keyframe: Keyframe | None = None
        self._worker.drop()

    def set_initial_pose(self, wTc: npt.ArrayLike, time_ns: int) -> None:
        """A first pose (4, 4) from elsewhere: a prediction, so the frame is still solved itself.

        Raises `LocalizationError` when it is no rigid motion.
        """
        T = np.array(wTc, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise LocalizationError("initial pose: a finite 4x4 matrix is needed")
        if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(T) < 0:
            raise LocalizationError("initial pose: its rotation is not orthonormal")
        self._motion.restart(time_ns, T)

    def process(self, time_ns: int, image: npt.NDArray[np.uint8], index: int = 0) -> PoseEstimate:
        """The pose of a grey frame (H, W) uint8 taken at `time_ns`.

        Raises `InputError` when its size is not the camera's. A frame that is not later than the
        one before is refused: its estimate says so and nothing else changes.
        """
        camera = self.camera
        if image.shape != (camera.height_px, camera.width_px):
            size = "x".join(str(n) for n in reversed(image.shape))
            raise InputError(
                f"frame {index} has {size} pixels, the camera {camera.width_px}x{camera.height_px}"
            )
        watch = Stopwatch()
        if (refused := self._refuse(time_ns, index, watch)) is not None:
            return refused
        entropy = entropy_bits(image)
        watch.lap("entropy")
        attempt = Attempt(time_ns, index, watch, entropy)
        limit = self.settings.gate.min_entropy_bits
        if entropy < limit:
            self._last_frame_ns = time_ns
            return self._gated(attempt, f"entropy {entropy:.2f} below {limit:g} bits")
        if (tracked := self._follow(attempt, image)) is not None:
            return tracked
        features = self.extractor.extract(image)
        watch.lap("features")
        estimate = self._locate(attempt, features)
        if self.settings.tracking.enabled and estimate.localized and not estimate.relocalized:
            # A relocalization is to be confirmed by features of the next frame: its own points
            # found again would only repeat it.
            self._keyframe = self._keyframe_of(attempt, image, estimate.wTc)
        return estimate

    def process_features(self, time_ns: int, features: Features, index: int = 0) -> PoseEstimate:
        """The same from features that were extracted elsewhere; nothing is gated."""
        watch = Stopwatch()
        refused = self._refuse(time_ns, index, watch)
        return refused or self._locate(Attempt(time_ns, index, watch), features)

    def _refuse(self, time_ns: int, index: int, watch: Stopwatch) -> PoseEstimate | None:
        last = self._last_frame_ns
        if last is None or time_ns > last:
            return None
        state = State.DEGRADED if self.state is State.TRACKING else self.state
        reason = f"refused: {(last - time_ns) / 1e9:.3f} s before the last frame"
        return PoseEstimate(time_ns, index, state, reason, stage_ms=watch.finish())

    def _follow(self, attempt: Attempt, image: npt.NDArray[np.uint8]) -> PoseEstimate | None:
        """The frame's pose from the keyframe's points; None when features of its own are needed."""
        settings = self.settings.tracking
        if (landed := self._worker.collect()) is not None:
            attempt.watch.lap("wait")
            attempt.watch.stage_ms["background"] = landed.background_ms
            # A keyframe whose features do not agree with its tracked pose is no ground to go on.
            self._keyframe = landed.keyframe
        keyframe = self._keyframe
        predicted = self._motion.predict(attempt.time_ns)
        if keyframe is None or predicted is None:
            return None
        tracks = track(keyframe, image, predicted, self.camera, settings)
        attempt.watch.lap("track")
        solution = failure(0, 0, "")
        if len(tracks.point) >= settings.min_inliers:
            pinhole_px = self.camera.undistort_to_pinhole(tracks.pixel_px)
            solution = self._believe(
                self._solve(
                    predicted,
                    keyframe.points_m[tracks.point],
                    pinhole_px,
                    self.camera,
                    self._tracked_pose,
                )
            )
            attempt.watch.lap("pose")
        inliers = int(solution.inlier.sum())
        if solution.wTc is None or inliers < settings.min_inliers:
            self._keyframe = None
            self._worker.drop()
            return None
        found = len(tracks.point)
        attempt.predicted = predicted
        attempt.counts = Counts(found, tracks.sought, found, inliers)
        attempt.observations = Observations(
            tracks.pixel_px, keyframe.landmark[tracks.point], solution.residual_px, solution.inlier
        )
        self._last_frame_ns = attempt.time_ns
        self._motion.update(attempt.time_ns, solution.wTc)
        age_s = (attempt.time_ns - keyframe.time_ns) / 1e9
        if not self._worker.busy and (
            age_s >= settings.keyframe_interval_s
            or inliers < settings.keyframe_min_share * len(keyframe)
        ):
            self._worker.submit(self._describing(attempt, image, solution.wTc))
        return self._solved(attempt, solution, tracked=True)

    def _describing(
        self, frame: Attempt, image: npt.NDArray[np.uint8], wTc: Array
    ) -> Callable[[], _Described]:
        """The job that makes a tracked frame at `wTc` (4, 4) the next keyframe.

        It changes nothing of the localizer, so that it can run beside the frames that follow.
        """
        attempt = Attempt(frame.time_ns, frame.index, frame.watch)
        settings = self.settings.association

        def job() -> _Described:
            attempt.watch = Stopwatch()
            self._describe(attempt, self.extractor.extract(image))
            radius_px = settings.refine_radius_px or settings.radius_px
            solution = self._track_once(attempt, wTc, radius_px)
            keyframe = self._keyframe_of(attempt, image, solution.wTc)
            return _Described(keyframe, attempt.watch.finish()["total"])

        return job

    def _keyframe_of(
        self, attempt: Attempt, image: npt.NDArray[np.uint8], wTc: Array | None
    ) -> Keyframe | None:
        """The inliers of a frame solved at `wTc` (4, 4); None when there are too few to follow."""
        settings, seen = self.settings.tracking, attempt.observations
        if wTc is None or seen.inlier.sum() < settings.min_inliers:
            return None
        pixel, landmark = seen.pixel_px[seen.inlier], seen.landmark[seen.inlier]
        chosen = spread_out(pixel, settings.max_points)
        pixel, landmark = pixel[chosen], landmark[chosen]
        position = np.asarray(self.map.landmarks.position_m[landmark], np.float64)
        return Keyframe(attempt.time_ns, image, wTc, pixel, landmark, position)

    def _locate(self, attempt: Attempt, features: Features) -> PoseEstimate:
        self._last_frame_ns = attempt.time_ns
        self._describe(attempt, features)
        attempt.predicted = self._motion.predict(attempt.time_ns)
        attempt.watch.lap("projection")
        if attempt.predicted is not None:
            solution = self._track(attempt, attempt.predicted)
        else:
            solution = failure(0, 0, "no first pose")
        if solution.wTc is not None:
            self._motion.update(attempt.time_ns, solution.wTc)
            return self._solved(attempt, solution)
        if self._may_relocalize(attempt.time_ns):
            found = self._relocalize(attempt)
            if found.wTc is not None:
                self._motion.restart(attempt.time_ns, found.wTc)
                return self._solved(attempt, found, relocalized=True)
            solution = found
        return self._unsolved(attempt, solution.reason)

    def _describe(self, attempt: Attempt, features: Features) -> None:
        finite = np.isfinite(features.keypoints_px).all(axis=1)
        finite &= np.isfinite(features.descriptors).all(axis=1)
        if not finite.all():
            features = Features(
                features.keypoints_px[finite],
                features.scores[finite],
                features.descriptors[finite],
            )
        attempt.features = features
        attempt.normalized = self.camera.undistort(features.keypoints_px)
        attempt.counts = Counts(features=len(features))

    def _track(self, attempt: Attempt, wTc: Array) -> PoseSolution:
        """Projects, associates and solves from a guess; once more, closer, if the settings say."""
        settings = self.settings.association
        solution = self._track_once(attempt, wTc, settings.radius_px)
        if solution.wTc is not None and settings.refine_radius_px > 0:
            solution = self._track_once(attempt, solution.wTc, settings.refine_radius_px)
        return solution

    def _track_once(self, attempt: Attempt, wTc: Array, radius_px: float) -> PoseSolution:
        landmarks, camera, settings = self.map.landmarks, self.camera, self.settings
        among = self._index.near(wTc, self._lens, settings.projection)
        projected = project(landmarks, wTc, self._lens, settings.projection, among)
        focal, centre = [camera.fx_px, camera.fy_px], [camera.cx_px, camera.cy_px]
        pinhole_px = attempt.normalized * focal + centre
        attempt.watch.lap("projection")
        pairs = associate(
            pinhole_px,
            attempt.features.descriptors,
            projected.pinhole_px,
            landmarks.descriptor[projected.landmark],
            settings.association,
            radius_px,
        )
        best = np.argsort(pairs.distance, kind="stable")[: settings.pose.max_observations]
        feature, landmark = pairs.feature[best], projected.landmark[pairs.candidate[best]]
        attempt.watch.lap("association")
        if len(best) < settings.pose.min_observations:
            solution = failure(len(best), 0, f"{len(best)} observations")
        else:
            solution = self._believe(
                self._solve(
                    wTc,
                    landmarks.position_m[landmark],
                    pinhole_px[feature],
                    camera,
                    settings.pose,
                )
            )
        attempt.watch.lap("pose")
        attempt.counts = Counts(
            len(attempt.features), len(projected.landmark), len(pairs), int(solution.inlier.sum())
        )
        attempt.observations = Observations(
            attempt.features.keypoints_px[feature], landmark, solution.residual_px, solution.inlier
        )
        return solution

    def _believe(self, solution: PoseSolution) -> PoseSolution:
        """The solution, or a failure when too few of its own observations agree with it."""
        settings, total = self.settings.pose, len(solution.inlier)
        inliers = int(solution.inlier.sum())
        enough = max(settings.min_inliers, settings.min_inlier_share * total)
        if solution.wTc is None or inliers >= enough:
            return solution
        return failure(total, solution.iterations, f"{inliers} inliers of {total} observations")

    def _may_relocalize(self, time_ns: int) -> bool:
        settings = self.settings.recovery
        tried = self._last_relocalization_ns
        waited = tried is None or time_ns - tried >= settings.interval_s * 1e9
        return settings.relocalize and waited and self._unsupported_state(time_ns) in (
            State.INITIALIZING,
            State.LOST,
        )  # fmt: skip

    def _relocalize(self, attempt: Attempt) -> PoseSolution:
        self._last_relocalization_ns = attempt.time_ns
        assert self._relocalizer is not None  # the settings say so: _may_relocalize
        found = self._relocalizer.find(attempt.features, attempt.normalized)
        attempt.watch.lap("relocalization")
        if isinstance(found, str):
            return failure(0, 0, found)
        return self._track(attempt, found.wTc)

    def _unsupported_state(self, time_ns: int, patience_s: float | None = None) -> State:
        """What a frame without a pose of its own leaves behind."""
        if self._last_solved_ns is None:
            return State.INITIALIZING
        patience_s = self.settings.state.lost_after_s if patience_s is None else patience_s
        recent = time_ns - self._last_solved_ns <= patience_s * 1e9
        return State.DEGRADED if recent and self.state is not State.LOST else State.LOST

    def _solved(
        self,
        attempt: Attempt,
        solution: PoseSolution,
        *,
        relocalized: bool = False,
        tracked: bool = False,
    ) -> PoseEstimate:
        settings, inliers = self.settings.state, attempt.counts.inliers
        self._last_solved_ns = attempt.time_ns
        width = spread(attempt.observations.pixel_px[solution.inlier], self.camera)
        self.state, reason = State.DEGRADED, ""
        if relocalized:
            reason = "relocalized; the next frame must confirm it"
        elif inliers < settings.good_inliers:
            reason = f"few inliers: {inliers}"
        elif width < settings.good_spread:
            reason = f"poor spread: {width:.3f}"
        else:
            self.state = State.TRACKING
        return self._estimate(attempt, reason, solution, relocalized=relocalized, tracked=tracked)

    def _unsolved(self, attempt: Attempt, reason: str) -> PoseEstimate:
        self.state = self._unsupported_state(attempt.time_ns)
        return self._estimate(attempt, reason)

    def _gated(self, attempt: Attempt, reason: str) -> PoseEstimate:
        # Skipped is not failed: until the prediction is no more than a held pose.
        patience_s = max(self.settings.state.lost_after_s, self.settings.motion.coast_s)
        self.state = self._unsupported_state(attempt.time_ns, patience_s)
        attempt.predicted = self._motion.predict(attempt.time_ns)
        return self._estimate(attempt, reason, gated=True)

    def _estimate(
        self,
        attempt: Attempt,
        reason: str,
        solution: PoseSolution | None = None,
        *,
        relocalized: bool = False,
        gated: bool = False,
        tracked: bool = False,
    ) -> PoseEstimate:
        return PoseEstimate(
            time_ns=attempt.time_ns,
            index=attempt.index,
            state=self.state,
            reason=reason,
            wTc=solution.wTc if solution else None,
            covariance=solution.covariance if solution else None,
            predicted_wTc=attempt.predicted,
            counts=attempt.counts,
            observations=attempt.observations if solution else no_observations(),
            stage_ms=attempt.watch.finish(),
            entropy_bits=attempt.entropy,
            gated=gated,
            relocalized=relocalized,
            tracked=tracked,
        )
