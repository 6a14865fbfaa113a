"""Flights in memory, and a localizer that gets their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from study.metrics import pose_errors

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.store import Map
from ground_station.recording.flight import trajectory_of
from ground_station.recording.frames import Frame
from ground_station.recording.open import open_input
from pi_firmware.wire.recording import RecordingReader


@dataclass
class Flight:
    """A flight's frames in memory, its camera and, where it is known, its truth."""

    name: str
    camera: Camera
    frames: list[Frame]
    truth: Trajectory | None
    about: str

    def true_wTc(self, frames: Sequence[Frame]) -> F64:
        """The true poses (N, 4, 4) of some of its frames."""
        assert self.truth is not None, f"{self.name} has no truth"
        return np.array([self.truth.at(f.time_ns) for f in frames]).reshape(-1, 4, 4)


def load_flight(spec: str, limit: int | None = None) -> Flight:
    """A recording, or `FOLDER@CAMERA.toml`; the first `limit` frames of it."""
    path, _, camera_file = spec.partition("@")
    source = open_input(path, 30.0)
    camera = load_camera(camera_file) if camera_file else source.camera
    assert camera is not None, f"{path} has no camera"
    frames = []
    for frame in source:
        frames.append(frame)
        if limit is not None and len(frames) >= limit:
            break
    is_recording = path.endswith(".mcap")
    truth = trajectory_of(path) if is_recording else None
    about = "/".join(Path(path).parts[-2:])
    if is_recording:
        made = RecordingReader(path).metadata_table("simulation")
        if made:
            words = [made.get(k, "?") for k in ("scene", "plan", "light")]
            about = f"{'/'.join(words)} seed {made.get('seed', '?')}"
    return Flight(Path(path).name, camera, frames, truth, about)


@dataclass
class Run:
    """What a localizer said of each frame it got."""

    frames: list[Frame] = field(default_factory=list)
    estimates: list[PoseEstimate] = field(default_factory=list)

    def says(self, state: State) -> Bools:
        """Which frames (N,) are in a state."""
        return np.array([e.state is state for e in self.estimates], bool)

    @property
    def localized(self) -> Bools:
        return np.array([e.localized for e in self.estimates], bool)

    @property
    def wTc(self) -> F64:
        """Poses (N, 4, 4); NaN where a frame has none."""
        none = np.full((4, 4), np.nan)
        found = [none if e.wTc is None else e.wTc for e in self.estimates]
        return np.array(found, np.float64).reshape(-1, 4, 4)

    def errors(self, true_wTc: F64) -> tuple[F64, F64]:
        """Distances (N,), metres, and angles (N,), degrees; NaN where a frame has no pose."""
        return pose_errors(self.wTc, true_wTc)


def make_localizer(map_: Map, camera: Camera, settings: LocalizerSettings) -> Localizer:
    return Localizer(map_, camera, extractor_for(map_.info, settings.features), settings)


def feed(
    localizer: Localizer, frames: Iterable[Frame], enough: Callable[[Run], bool] | None = None
) -> Run:
    """Gives frame after frame, until `enough` is true of the run so far, or to their end."""
    run = Run()
    for frame in frames:
        run.frames.append(frame)
        run.estimates.append(
            localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s)
        )
        if enough is not None and enough(run):
            break
    return run


def joined(parts: Sequence[Sequence[Frame]], rate_hz: float = 30.0) -> list[Frame]:
    """Pieces of flights one after the other as one stream with times that go on evenly."""
    frames = [frame for part in parts for frame in part]
    return [
        replace(frame, index=k, time_ns=1_000_000_000 + round(k * 1e9 / rate_hz))
        for k, frame in enumerate(frames)
    ]
