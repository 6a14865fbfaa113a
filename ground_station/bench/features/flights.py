"""Simulated flights through the sample building in other light than the map's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ground_station.bench.features.localizing import localized, registered_map
from ground_station.errors import InputError
from ground_station.localization.settings import LocalizerSettings
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.flight import FlightRecording, trajectory_of
from ground_station.recording.frames import FrameRange
from pi_firmware.wire import files
from pi_firmware.wire.recording import TRUTH_TOPIC

PLAN, LIGHT, SEED = "loop", "sunset", 41
FULL_S, QUICK_S = 20.0, 4.0
FULL_STEP, QUICK_STEP = 1, 3
"""Every so manieth frame of the mapping flight is an image of the map."""


def map_inputs(sample: Path) -> list[Path]:
    """The noon flight and its map's settings; raises `InputError` naming what is missing."""
    paths = [sample / name for name in ("mapping.mcap", "mapping.toml")]
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: there is no such file; `make sample` makes it anew")
    return paths


def flight(folder: Path, duration_s: float) -> Path:
    """The sunset flight, simulated where it is not there yet; always the same one."""
    # The simulator stands above this room: only its recordings are known here, but for this.
    from ground_station.simulator.simulate import SimulationSettings, simulate

    path = folder / f"{PLAN}-{LIGHT}-{SEED}-{duration_s:g}s.mcap"
    if path.is_file():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"part-{path.name}")
    settings = SimulationSettings(
        out=part, plan=PLAN, light=LIGHT, seed=SEED, duration_s=duration_s, crf=23.0
    )
    with Progress(f"simulate {path.name}, frames", None) as progress:
        made = simulate(settings, lambda done, total: progress.step(total))
    if made.interrupted:
        part.unlink(missing_ok=True)
        raise KeyboardInterrupt
    files.replace(part, path)
    return path


def measure(
    sample: Path,
    recording: Path,
    mapping: MappingSettings,
    localizer: LocalizerSettings,
    step: int,
    work: Path,
) -> dict[str, Any]:
    """Builds the noon map in `work` and localizes the flight from its true first pose.

    The map is registered by the mapping flight's true poses, so that an error is the features'.
    Raises `MapError` where these features make no map.
    """
    noon = sample / "mapping.mcap"
    source = FlightRecording(noon, FrameRange(0, None, step))
    if source.camera is None:
        raise InputError(f"{noon}: it carries no camera calibration")
    flown_at_noon = trajectory_of(noon, TRUTH_TOPIC, [])
    map_ = registered_map(source, source.camera, mapping, work / "map", trajectory=flown_at_noon)
    row = {"registered": len(map_.keyframes), "landmarks": len(map_.landmarks)}
    flown = FlightRecording(recording)
    camera = flown.camera or map_.info.camera
    truth = trajectory_of(recording, TRUTH_TOPIC, [])
    return row | localized(map_, flown, camera, localizer, truth, told=True)
