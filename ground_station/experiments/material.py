"""A flight that is there, simulated or real: what maps are made of and localizers see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ground_station.errors import InputError
from ground_station.experiments.declaration import FlightDeclaration
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import FrameRange, FrameSource
from ground_station.recording.open import open_input, parse_range
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingReader


@dataclass(frozen=True)
class Flown:
    """A flight that is there: its frames, camera and true poses; `recording` if it is simulated."""

    frames: FrameSource
    camera: Camera
    truth: Trajectory
    recording: Path | None

    def units(self) -> Iterator[bytes]:
        """Its H.264 access units; none of a folder of pictures."""
        if self.recording is not None:
            for sample in RecordingReader(self.recording).video():
                yield sample.data


def flown(
    flight: FlightDeclaration, recording: Path | None, data: Path, lens: Path | None = None
) -> Flown:
    """A flight's frames; raises `InputError` naming what is missing.

    `recording` is the simulated one's, its camera the recording's own or the file `lens`; a folder
    of real pictures lies below `data`.
    """
    if recording is not None:
        source = FlightRecording(recording)
        if source.camera is None:
            raise InputError(f"{recording}: it carries no camera calibration")
        truth = trajectory_of(recording, TRUTH_TOPIC)
        above_m = np.array([0.0, 0.0, flight.storey_m])
        truth = replace(truth, position_m=truth.position_m + above_m)
        camera = source.camera if lens is None else load_camera(lens)
        return Flown(source, camera, truth, recording)
    if not (flight.truth and flight.camera):
        raise InputError(f"the folder '{flight.folder}' needs 'truth' and 'camera' beside it")
    wanted = parse_range(flight.range) if flight.range else FrameRange()
    pictures = open_input(data / flight.folder, flight.rate_hz, wanted)
    return Flown(pictures, load_camera(data / flight.camera), read_tum(data / flight.truth), None)
