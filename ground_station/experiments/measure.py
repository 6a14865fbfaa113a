"""One run: a localizer, a map and a flight; its figures, frame by frame and in all.

The plain baseline, `Alone`, takes each frame by itself, against every landmark of the map: mutually
nearest descriptors that pass the ratio test (Lowe, IJCV 2004, 7.1), COLMAP's LO-RANSAC and
refinement of the pose. No motion, no time, no prediction: whoever has them must not be worse.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ground_station.arrays import F64, U8
from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.experiments.alter import Alteration
from ground_station.experiments.maps import displacement
from ground_station.experiments.material import Flown
from ground_station.features.extractor import Extractor
from ground_station.features.settings import OF_THE_MAP
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization import results
from ground_station.localization.estimate import Counts, PoseEstimate, State
from ground_station.localization.extraction import extractor_for
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.localizer import Localizer
from ground_station.localization.relocalization import match_all
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.colmap import HALF_PIXEL, colmap_camera
from ground_station.map.store import Map

_ALONE_EVERY = 5
"""Without motion or time every fifth frame of a simulated flight says what all would, and each
takes a quarter of a second."""
_SAME_S = 0.005
"""A frame is judged by a true pose within this time of its own."""
_NEAR_M = 0.5
"""A place is found again when the pose is so near the true one."""
_WRONG_M, _WRONG_DEG = 0.25, 3.0
_STAGES = ("features", "projection", "association", "pose", "total")
_FEATURES = 2000
_MAX_RATIO, _MAX_ERROR_PX, _MIN_INLIERS = 0.8, 6.0, 12


class Alone:
    """Localizes frames one by one, called as a `Localizer` is."""

    def __init__(self, map_: Map, camera: Camera, extractor: Extractor) -> None:
        self._points_m = map_.landmarks.position_m
        self._descriptors = map_.landmarks.descriptor[:]
        self._camera, self._extractor = colmap_camera(camera), extractor

    def process(
        self, time_ns: int, image: U8, index: int = 0, exposure_s: float | None = None
    ) -> PoseEstimate:
        """TRACKING with a pose, or LOST."""
        import pycolmap

        begun_s = time.perf_counter()
        features = self._extractor.extract(image)
        feature, landmark = match_all(features.descriptors, self._descriptors, _MAX_RATIO)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = _MAX_ERROR_PX
        found = None
        if len(feature) >= _MIN_INLIERS:
            found = pycolmap.estimate_and_refine_absolute_pose(
                features.keypoints_px[feature].astype(np.float64) + HALF_PIXEL,
                self._points_m[landmark], self._camera, options,
            )  # fmt: skip
        inliers = int(found["num_inliers"]) if found else 0
        wTc = None
        if found and inliers >= _MIN_INLIERS:
            cTw = found["cam_from_world"].matrix()
            wTc = poses.inverse(poses.pose(cTw[:, :3], cTw[:, 3]))
        return PoseEstimate(
            time_ns,
            index,
            State.LOST if wTc is None else State.TRACKING,
            wTc=wTc,
            counts=Counts(len(self._points_m), inliers),
            stage_ms={"total": 1e3 * (time.perf_counter() - begun_s)},
        )

    def smoothed(self) -> list[Kinematics]:
        """Nothing: no frame helps another."""
        return []

    finish = smoothed


def measure(
    map_: Map,
    flight: Flown,
    alteration: Alteration,
    preset: str,
    settings: LocalizerSettings,
    seed: int,
) -> dict[str, Any]:
    """Localizes a flight; plain values for the report.

    Only the preset thesis is told its true first pose: its method has no other way to begin.
    `first_s` is the time to the first right pose of one that is not, `wrong` counts the frames that
    are TRACKING and further off than 0.25 m or 3°. `registration_m` is the share of a registration
    by clicked points. Of the frames that the camera `captured`,
    `frames` would have been seen, had none been lost. `series` has for each localized frame: time
    since the flight's first frame (s), position in the world (m), both errors. Errors are of the
    unaligned poses; None where no frame was localized.
    """
    features = replace(settings.features, extractor=OF_THE_MAP)
    settings = replace(settings, features=features)
    camera = alteration.camera(flight.camera)
    localizer: Localizer | Alone
    if preset == "alone":
        plain = replace(features, max_features=_FEATURES)
        localizer = Alone(map_, camera, extractor_for(map_.info, plain))
    else:
        extractor = extractor_for(map_.info, features)
        localizer = Localizer(map_, camera, extractor, settings, smoothing=True)
        if preset == "thesis":
            first = next(iter(flight.frames))
            wTc = flight.truth.wTc[flight.truth.nearest(first.time_ns)]
            localizer.set_initial_pose(wTc, alteration.told_ns(first, seed))
    arrived = alteration.arrivals(flight, seed)
    start_ns = next(iter(flight.frames)).time_ns
    estimates: list[PoseEstimate] = []
    smoothed: list[Kinematics] = []
    step = _ALONE_EVERY if preset == "alone" and flight.recording is not None else 1
    true_ns: dict[int, int] = {}
    for frame in itertools.islice(alteration.frames(flight.frames, arrived), 0, None, step):
        time_ns = alteration.told_ns(frame, seed)
        true_ns[time_ns] = frame.time_ns
        estimate = localizer.process(time_ns, frame.image, frame.index, frame.exposure_s)
        estimates.append(replace(estimate, time_ns=frame.time_ns))
        smoothed += localizer.smoothed()
    smoothed += localizer.finish()
    smoothed = [replace(state, time_ns=true_ns[state.time_ns]) for state in smoothed]
    tracking = [e for e in estimates if e.state is State.TRACKING and e.wTc is not None]
    off = [(e, error) for e in tracking if (error := _off(e, flight.truth)) is not None]
    right = [e.time_ns for e, error in off if _right(error)]
    captured = flight.frames.count() or len(estimates)
    return {
        "captured": captured,
        "frames": -(-sum(map(alteration.keeps, range(captured))) // step),
        "seen_s": [round((e.time_ns - start_ns) / 1e9, 4) for e in estimates],
        "localized": sum(e.localized for e in estimates),
        "tracking": len(tracking),
        "wrong": sum(not _right(error) for _, error in off),
        "first_s": (right[0] - start_ns) / 1e9 if right and preset != "thesis" else None,
        "registration_m": _registration_m(map_, flight.truth),
        "landmarks": len(map_.landmarks),
        "keyframes": len(map_.keyframes),
        "stage_s": _stages(estimates),
        "recovery_s": _recovery_s(estimates, flight.truth, alteration.blind_until_s),
        "consistency": _consistency(
            [(c, error) for e, error in off if (c := e.covariance) is not None]
        ),
        **_errors(estimates, flight.truth, start_ns),
        **_smoothed(smoothed, flight.truth),
    }


def _errors(estimates: Sequence[PoseEstimate], truth: Trajectory, start_ns: int) -> dict[str, Any]:
    found = _against(results.trajectory(estimates), truth)
    if found is None:
        nothing = ("position_m", "rotation_deg", "position_zhang_m", "aligned_m", "p95_m")
        return dict.fromkeys(nothing) | {"series": {}}
    estimate, errors, aligned = found.estimate, found.errors["none"], found.ate()["se3"]
    return {
        **errors.rmse(),
        "aligned_m": aligned and aligned["position_m"],
        "p95_m": float(np.percentile(errors.position_m, 95)),
        "series": {
            "time_s": _rounded((estimate.time_ns - start_ns) / 1e9),
            "x_m": _rounded(estimate.position_m[:, 0]),
            "y_m": _rounded(estimate.position_m[:, 1]),
            "position_m": _rounded(errors.position_m),
            "rotation_deg": _rounded(errors.rotation_deg),
        },
    }


def _against(estimate: Trajectory, truth: Trajectory) -> ate.Evaluation | None:
    """The errors, `se3` as a comparison without a common frame sees them; None where no pose has a
    true one of its time."""
    try:
        return ate.evaluate(estimate, truth, _SAME_S)
    except InputError:
        return None


def _registration_m(map_: Map, truth: Trajectory) -> float | None:
    """RMS over the flight of what the map's registration alone displaces; None: registered by the
    truth."""
    off_m = displacement(map_, truth.position_m)
    return None if off_m is None else float(np.sqrt(np.mean(np.square(off_m))))


def _off(e: PoseEstimate, truth: Trajectory) -> F64 | None:
    """A pose's error (6,) in the camera's axes, rad and m; None without a truth of its time."""
    nearest = truth.nearest(e.time_ns)
    if e.wTc is None or abs(int(truth.time_ns[nearest]) - e.time_ns) > _SAME_S * 1e9:
        return None
    return poses.log(poses.inverse(e.wTc) @ truth.wTc[nearest])


def _right(error: F64) -> bool:
    turn_deg, step_m = np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:])
    return bool(step_m <= _WRONG_M and turn_deg <= _WRONG_DEG)


def _consistency(found: Sequence[tuple[F64, F64]]) -> dict[str, float] | None:
    """How well errors fit their covariances: the mean NEES (6 where they fit; Bar-Shalom et al.,

    Estimation with Applications to Tracking and Navigation, 2001, 5.4) and the share of frames
    inside the 95 % ellipsoid. None where no covariance was published.
    """
    if not found:
        return None
    values = [float(error @ np.linalg.solve(covariance, error)) for covariance, error in found]
    inside = np.asarray(values) <= _CHI2_95_6
    return {"nees": float(np.mean(values)), "inside_95": float(np.mean(inside))}


_CHI2_95_6 = 12.591587
"""95 % quantile of χ² with 6 degrees of freedom."""


def _smoothed(states: Sequence[Kinematics], truth: Trajectory) -> dict[str, Any]:
    ordered = sorted(states, key=lambda state: state.time_ns)
    times = [state.time_ns for state in ordered]
    found = _against(Trajectory.from_poses(times, [state.wTc for state in ordered]), truth)
    return {"smoothed_m": None if found is None else found.errors["none"].rmse()["position_m"]}


def _recovery_s(
    estimates: Sequence[PoseEstimate], truth: Trajectory, blind_until_s: float | None
) -> float | None:
    """From the uncovered lens to a TRACKING pose near the true one; None: never, or not covered."""
    if blind_until_s is None or not estimates:
        return None
    end_ns = estimates[0].time_ns + round(blind_until_s * 1e9)
    for e in estimates:
        if e.time_ns < end_ns or e.state is not State.TRACKING or e.wTc is None:
            continue
        if np.linalg.norm(e.wTc[:3, 3] - truth.at(e.time_ns)[:3, 3]) <= _NEAR_M:
            return (e.time_ns - end_ns) / 1e9
    return None


def _stages(estimates: Sequence[PoseEstimate]) -> dict[str, float]:
    """The median time of each of the thesis's stages, seconds, over the frames where it ran."""
    spans = {name: [e.stage_ms[name] for e in estimates if name in e.stage_ms] for name in _STAGES}
    return {name: round(float(np.median(v)) / 1e3, 5) for name, v in spans.items() if v}


def _rounded(values: F64) -> list[float]:
    return [round(float(value), 4) for value in values]
