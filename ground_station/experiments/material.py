"""What experiments work on: flights, simulated once and kept, and maps of them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ground_station.errors import InputError
from ground_station.experiments.declaration import Flight, MapSpec
from ground_station.geometry.camera import Camera, load_camera
from ground_station.geometry.trajectory import Trajectory, read_tum
from ground_station.mapping import store
from ground_station.mapping.construction.build import build_map
from ground_station.mapping.refinement.refine import straighten
from ground_station.mapping.registration.register import register_map
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import Frame, FrameRange, FrameSource
from ground_station.recording.open import open_input, parse_range
from ground_station.simulator.simulate import SimulationSettings, simulate
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


def file_name(flight: Flight, seed: int) -> str:
    """What a simulated flight's recording is called: all that it depends on but the program."""
    rate = f"-{flight.bitrate_kbps}kbps" if flight.bitrate_kbps else ""
    air = "" if flight.draught_m_s is None else f"-{flight.draught_m_s:g}ms"
    return (
        f"{flight.scene}-{flight.plan}-{flight.light}-{seed}"
        f"-{flight.duration_s:g}s-{flight.rate_hz:g}Hz{rate}{air}.mcap"
    )


def fly(flight: Flight, seed: int, path: Path) -> None:
    """Simulates a flight into a recording, written whole or not at all."""
    settings = SimulationSettings(
        out=path,
        scene=flight.scene,
        plan=flight.plan,
        light=flight.light,
        seed=seed,
        duration_s=flight.duration_s,
        rate_hz=flight.rate_hz,
        bitrate_kbps=flight.bitrate_kbps or None,
        draught_m_s=flight.draught_m_s,
    )
    if simulate(settings).interrupted:
        path.unlink(missing_ok=True)
        raise KeyboardInterrupt


def flown(flight: Flight, recording: Path | None, data: Path, step: int = 1) -> Flown:
    """A flight's frames, every `step`-th; raises `InputError` naming what is missing.

    `recording` is the simulated one's; a folder of real pictures lies below `data`.
    """
    if recording is not None:
        source = FlightRecording(recording, FrameRange(0, None, step))
        if source.camera is None:
            raise InputError(f"{recording}: it carries no camera calibration")
        return Flown(source, source.camera, trajectory_of(recording, TRUTH_TOPIC), recording)
    if not (flight.truth and flight.camera):
        raise InputError(f"the folder '{flight.folder}' needs 'truth' and 'camera' beside it")
    wanted = parse_range(flight.range) if flight.range else FrameRange()
    wanted = replace(wanted, step=wanted.step * step)
    pictures = open_input(data / flight.folder, flight.rate_hz, wanted)
    return Flown(pictures, load_camera(data / flight.camera), read_tum(data / flight.truth), None)


def build(
    spec: MapSpec, recording: Path | None, data: Path, settings: MappingSettings, folder: Path
) -> store.Map:
    """The map of a flight's frames in `folder`, registered by its true poses.

    An error against it is then the localizer's and the landmarks', not the registration's.
    """
    whole = flown(spec.flight, recording, data)
    total = whole.frames.count()
    if total is None:
        total = sum(1 for _ in whole.frames)
    step = max(1, round(total / spec.images)) if spec.images else 1
    source = flown(spec.flight, recording, data, step)
    build_map(
        _few(source.frames, spec.images), source.camera, replace(settings, features=spec.features),
        folder, total=spec.images or total,
    )  # fmt: skip
    straighten(folder, settings)
    return register_map(folder, trajectory=source.truth, source="truth")[0]


def _few(frames: FrameSource, most: int) -> Iterator[Frame]:
    for k, frame in enumerate(frames):
        if most and k >= most:
            return
        yield frame


def moved(part: Path, folder: Path) -> None:
    """Puts what was made beside in its place; what lay there, a cut attempt, goes."""
    shutil.rmtree(folder, ignore_errors=True)
    part.replace(folder)
