"""One flight in maps of several sizes: errors, frames localized, places found again, time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.bench.features.localizing import figures
from ground_station.errors import InputError
from ground_station.evaluation import ate
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.localization.estimate import PoseEstimate
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.sizes import sizes
from ground_station.map.store import Map, load
from ground_station.map_update.compression.compress import Compression, compress_map
from ground_station.progress import Progress
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import FrameRange, FrameSource
from ground_station.recording.open import open_input
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingReader

FOUND_M, FOUND_DEG = ate.THRESHOLDS[-1]
"""A frame that is searched in the whole map counts as found within these of its true pose."""

_SIMULATION = "simulation"
"""The simulator's recordings carry a table of this name."""


@dataclass(frozen=True)
class Flight:
    """Frames with true poses; `simulated` where a simulator made them."""

    path: Path
    chosen: FrameRange
    truth: Trajectory
    simulated: bool

    @property
    def name(self) -> str:
        return self.path.stem

    def frames(self) -> FrameSource:
        """All chosen frames, decoded anew."""
        return open_input(self.path, frame_range=self.chosen)


def open_flight(path: Path, chosen: FrameRange, truth: Path | None) -> Flight:
    """A flight and its true poses: its own, or those of a TUM file.

    Raises `InputError` where there are none.
    """
    recorded = isinstance(open_input(path, frame_range=chosen), FlightRecording)
    simulated = recorded and bool(RecordingReader(path).metadata_table(_SIMULATION))
    if truth is not None:
        return Flight(path, chosen, read_tum(truth), simulated)
    if not recorded:
        raise InputError(f"{path}: it carries no true poses; --truth TUM.txt is needed")
    return Flight(path, chosen, trajectory_of(path, TRUTH_TOPIC, []), simulated)


@dataclass(frozen=True)
class Sought:
    """Frames of a flight that are looked for in the whole map: their features, extracted once."""

    camera: Camera
    time_ns: list[int]
    features: list[Features]


def seek(flight: Flight, map_: Map, settings: LocalizerSettings, count: int) -> Sought:
    """`count` frames, spread evenly over the flight; all where it has fewer."""
    source = flight.frames()
    camera = source.camera or map_.info.camera
    if not count:
        return Sought(camera, [], [])
    extractor = extractor_for(map_.info, settings.features)
    total = source.count()
    every = max(1, (total or count) // count)
    times: list[int] = []
    features: list[Features] = []
    with Progress(f"{flight.name}, frames sought", count) as progress:
        for k, frame in enumerate(source):
            if k % every == every // 2 and len(times) < count:
                times.append(frame.time_ns)
                features.append(extractor.extract(frame.image))
                progress.step()
    return Sought(camera, times, features)


def localize(map_: Map, flight: Flight, settings: LocalizerSettings, label: str) -> dict[str, Any]:
    """The figures of a flight in a map from its true first pose, and `ms`, a frame's mean time.

    A frame's time is from its picture to its pose; what runs beside the frames is in it only where
    a frame waits for it.
    """
    source = flight.frames()
    camera = source.camera or map_.info.camera
    localizer = Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)
    estimates: list[PoseEstimate] = []
    with Progress(label, source.count()) as progress:
        for frame in source:
            if not estimates:
                first = flight.truth.wTc[flight.truth.nearest(frame.time_ns)]
                localizer.set_initial_pose(first, frame.time_ns)
            estimates.append(
                localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s)
            )
            progress.step()
    spent = [e.stage_ms["total"] for e in estimates]
    return figures(estimates, flight.truth) | {"ms": float(np.mean(spent))}


def relocalize(
    map_: Map, sought: Sought, truth: Trajectory, settings: LocalizerSettings
) -> dict[str, int]:
    """Of frames that nothing is known of: how many are `found` in the map, and how many `wrong`."""
    extractor = extractor_for(map_.info, settings.features)
    localizer = Localizer(map_, sought.camera, extractor, settings)
    found = wrong = 0
    for time_ns, features in zip(sought.time_ns, sought.features, strict=True):
        localizer.reset()
        estimate = localizer.process_features(time_ns, features)
        if estimate.wTc is None:
            continue
        right = _is_near(estimate.wTc, truth.at(time_ns))
        found, wrong = found + right, wrong + (not right)
    return {"sought": len(sought.time_ns), "found": found, "wrong": wrong}


def _is_near(wTc: npt.NDArray[np.float64], true: npt.NDArray[np.float64]) -> bool:
    apart = poses.inverse(true) @ wTc
    turned = float(np.degrees(poses.rotation_angle(apart[:3, :3])))
    return bool(np.linalg.norm(apart[:3, 3]) <= FOUND_M and turned <= FOUND_DEG)


def row(
    folder: Path,
    wanted: Compression | None,
    flights: Sequence[tuple[Flight, Sought]],
    settings: LocalizerSettings,
    seeds: Sequence[int],
    work: Path,
) -> dict[str, Any]:
    """A line of the table: the map itself where nothing is `wanted`, or what is made of it.

    Each seed makes a map and a run of each flight; `flights` has, by name, the figures of each run
    and their means.
    """
    runs: dict[str, list[dict[str, Any]]] = {flight.name: [] for flight, _ in flights}
    made: dict[str, Any] = {}
    for seed in seeds:
        place, told = folder, dict[str, Any]()
        if wanted is not None:
            place = work / "map"
            _, told = compress_map(folder, place, replace(wanted, seed=seed))
        map_, with_seed = load(place), replace(settings, seed=seed)
        made = {
            "landmarks": len(map_.landmarks),
            "descriptor_error": told.get("descriptor_error", 0.0),
            "in_keyframe": told.get("in_keyframe"),
            "bytes": sizes(place),
        }
        for flight, sought in flights:
            label = f"{flight.name}, {len(map_.landmarks)} landmarks, seed {seed}"
            run = localize(map_, flight, with_seed, label)
            run |= relocalize(map_, sought, flight.truth, with_seed)
            runs[flight.name].append(run)
    return made | {
        "flights": {name: _mean(found) | {"runs": found} for name, found in runs.items()}
    }


def _mean(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Means over the runs; a run that localized nothing makes the errors NaN."""
    keys = ("rmse_m", "rmse_deg", "median_m", "ms")
    mean = {key: float(np.mean([run[key] for run in runs])) for key in keys}
    for name, part, whole in (
        ("localized", "localized", "judged"),
        ("found", "found", "sought"),
        ("wrong", "wrong", "sought"),
    ):
        total = sum(run[whole] for run in runs)
        mean[f"{name}_share"] = sum(run[part] for run in runs) / max(total, 1)
    return mean
