"""What the localizer's steps cost, each beside what it is measured against, in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64
from ground_station.evaluation import ate
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization import results
from ground_station.localization.association import associate
from ground_station.localization.estimate import PoseEstimate
from ground_station.localization.extraction import extractor_for
from ground_station.localization.kinematics import Kinematics, LandmarkObservations
from ground_station.localization.localizer import Localizer
from ground_station.localization.pose_alone import solve_graph
from ground_station.localization.pose_rolling import solve_rolling
from ground_station.localization.settings import (
    PRESETS,
    AssociationSettings,
    PoseSettings,
    load_preset,
)
from ground_station.map.store import Map
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import Frame, FrameRange
from pi_firmware.wire.recording import TRUTH_TOPIC

Pairs = list[tuple[int, int]]

_FEATURES, _LANDMARKS, _DIMENSION, _RADIUS_PX = 1000, 3000, 256, 40.0
_OBSERVATIONS, _OUTLIERS = 400, 0.2


def medians_ms(repetitions: int, *works: Callable[[], object]) -> list[float]:
    """The median time of a call of each, in milliseconds.

    They take turns, so that a busy moment of the machine slows all; a first turn warms up.
    """
    spans = np.empty((repetitions + 1, len(works)))
    for row in spans:
        for k, work in enumerate(works):
            begin = time.perf_counter()
            work()
            row[k] = 1e3 * (time.perf_counter() - begin)
    return [float(median) for median in np.median(spans[1:], axis=0)]


def association(seed: int, repetitions: int) -> dict[str, Any]:
    """Ours and a loop of one query a feature on one tree, on the same features; do they agree?"""
    rng = np.random.default_rng(seed)
    landmark_px = rng.uniform(0, 1, (_LANDMARKS, 2)) * [640, 480]
    landmark = _unit(rng.normal(size=(_LANDMARKS, _DIMENSION)))
    own = rng.permutation(_LANDMARKS)[:_FEATURES]
    feature_px = landmark_px[own] + rng.normal(0, 5, (_FEATURES, 2))
    noise = rng.normal(0, 0.4 / np.sqrt(_DIMENSION), (_FEATURES, _DIMENSION))
    feature = _unit(landmark[own] + noise)
    settings = AssociationSettings(radius_px=_RADIUS_PX)
    data = (feature_px, feature, landmark_px, landmark, settings)
    found = associate(*data)
    pairs = list(zip(found.feature.tolist(), found.candidate.tolist(), strict=True))
    ours, loop = medians_ms(
        repetitions, lambda: associate(*data), lambda: _associate_by_loop(*data)
    )
    return {
        "ours_ms": ours,
        "loop_ms": loop,
        "ratio": loop / ours,
        "pairs": len(pairs),
        "same": pairs == _associate_by_loop(*data),
    }


def _associate_by_loop(
    feature_px: F64,
    feature: F32,
    landmark_px: F64,
    landmark: F32,
    settings: AssociationSettings,
) -> Pairs:
    tree = cKDTree(landmark_px)
    best: dict[int, tuple[float, int]] = {}
    for i, pixel in enumerate(feature_px):
        near = tree.query_ball_point(pixel, settings.radius_px)
        if not near:
            continue
        distance = np.linalg.norm(landmark[near] - feature[i], axis=1)
        nearest = int(np.argmin(distance))
        apart, j = float(distance[nearest]), near[nearest]
        if apart < settings.max_descriptor_distance and (j not in best or apart < best[j][0]):
            best[j] = apart, i
    return sorted((i, j) for j, (_, i) in best.items())


def _unit(rows: npt.NDArray[Any]) -> F32:
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)


def pose(seed: int, repetitions: int) -> dict[str, Any]:
    """Pose and velocity by rows, and the pose by the thesis's graph, from the same observations."""
    rng = np.random.default_rng(seed)
    camera = THESIS_CAMERA
    depth = rng.uniform(2, 8, _OBSERVATIONS)
    flat = rng.uniform([-0.55, -0.42], [0.55, 0.42], (_OBSERVATIONS, 2))
    wTc = poses.exp([0.1, -0.4, 0.2, 1.0, 2.0, 3.0])
    points = poses.transform(wTc, np.c_[flat, np.ones(_OBSERVATIONS)] * depth[:, None])
    pixels = flat * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    pixels += rng.normal(0, 1, pixels.shape)
    wrong = rng.permutation(_OBSERVATIONS)[: round(_OUTLIERS * _OBSERVATIONS)]
    pixels[wrong] += rng.uniform(-40, 40, (len(wrong), 2))
    guess = wTc @ poses.exp([0.02, -0.03, 0.02, 0.08, -0.05, 0.06])
    settings = PoseSettings(sigma_px=2.0, landmark_sigma_m=0.01)
    middle = 0.5 * (camera.height_px - 1)
    observations = LandmarkObservations(
        points,
        pixels,
        camera.readout_s * (camera.distort(flat)[:, 1] - middle) / (2 * middle),
        np.full(_OBSERVATIONS, settings.sigma_px),
        np.tile(settings.landmark_sigma_m**2 * np.eye(3), (_OBSERVATIONS, 1, 1)),
        np.ones(_OBSERVATIONS),
        np.zeros((_OBSERVATIONS, 3)),
    )
    sigma = np.repeat([0.05, 0.1, 0.5, 0.5], 3)
    predicted = Kinematics(0, guess, np.zeros(6), np.diag(sigma**2))
    data = (predicted, observations, camera, settings)
    for solve in (solve_graph, solve_rolling):
        assert solve(*data).state is not None
    graph, rolling = medians_ms(
        repetitions, lambda: solve_graph(*data), lambda: solve_rolling(*data)
    )
    return {
        "graph_ms": graph,
        "rolling_ms": rolling,
        "ratio": graph / rolling,
        "landmark_sigma_m": settings.landmark_sigma_m,
    }


def frames(map_: Map, recording: Path, count: int) -> dict[str, Any]:
    """Every preset on the first frames of a flight, each from its true first pose, by stage.

    Each frame's time is from its picture to its pose; decoding stands beside it. A stage's time is
    its mean over all frames, whether it ran in them or not, so that stages add up to the total.
    """
    source = FlightRecording(recording, FrameRange(0, count))
    truth = trajectory_of(recording, TRUTH_TOPIC, [])
    pictures: list[Frame] = []
    begin = time.perf_counter()
    pictures.extend(source)
    decode_ms = 1e3 * (time.perf_counter() - begin) / max(len(pictures), 1)
    camera = source.camera or map_.info.camera
    result: dict[str, Any] = {"frames": len(pictures), "decode_ms": decode_ms, "presets": {}}
    for preset in PRESETS:
        estimates = _fly(map_, camera, preset, pictures, truth)
        stages = dict.fromkeys(stage for e in estimates for stage in e.stage_ms)
        total = [e.stage_ms["total"] for e in estimates]
        estimate = results.trajectory(estimates)
        errors = ate.evaluate(estimate, truth).errors["none"] if len(estimate) else None
        result["presets"][preset] = {
            "localized": sum(e.localized for e in estimates),
            "mean_ms": {
                stage: float(sum(e.stage_ms.get(stage, 0.0) for e in estimates) / len(estimates))
                for stage in stages
            },
            "p50_ms": float(np.median(total)),
            "p99_ms": float(np.percentile(total, 99)),
            "position_rmse_m": errors.rmse()["position_m"] if errors else float("nan"),
        }
    means = {preset: result["presets"][preset]["mean_ms"]["total"] for preset in PRESETS}
    result["ratio"] = means["thesis"] / means["default"]
    return result


def _fly(
    map_: Map, camera: Camera, preset: str, pictures: list[Frame], truth: Trajectory
) -> list[PoseEstimate]:
    settings = load_preset(preset)
    localizer = Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)
    first = pictures[0].time_ns
    localizer.set_initial_pose(truth.wTc[truth.nearest(first)], first)
    return [localizer.process(frame.time_ns, frame.image, frame.index) for frame in pictures]
