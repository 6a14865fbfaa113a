"""The red kitchen of 7-Scenes: a map of one pass, localization in the other, real pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ground_station.bench.features.localizing import localized, registered_map
from ground_station.errors import InputError
from ground_station.geometry.camera import load_camera
from ground_station.geometry.trajectory import read_tum
from ground_station.localization.settings import LocalizerSettings
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import FrameRange
from ground_station.recording.open import open_input

RATE_HZ = 30.0
TRUTH = "pseudo_groundtruth.txt"
FULL = FrameRange(0, 500, 5), FrameRange(500, 1000)
QUICK = FrameRange(0, 500, 20), FrameRange(500, 620)
"""The map's frames and the query's."""


def inputs(folder: Path) -> list[Path]:
    """The files that a row depends on; raises `InputError` naming what is missing."""
    frames = folder / "frames"
    if not frames.is_dir():
        raise InputError(f"{frames}: there is no such folder")
    for name in ("camera.toml", TRUTH):
        if not (folder / name).is_file():
            raise InputError(f"{folder / name}: there is no such file")
    return [folder / "camera.toml", folder / TRUTH, *sorted(frames.iterdir())]


def measure(
    folder: Path,
    mapping: MappingSettings,
    localizer: LocalizerSettings,
    ranges: tuple[FrameRange, FrameRange],
    work: Path,
) -> dict[str, Any]:
    """Builds the map in `work`, localizes the other pass without a first pose: the figures.

    The map is registered by the same trajectory, which is independent of the map's features but
    was itself made with SIFT. Raises `MapError` where these features make no map.
    """
    camera, truth = load_camera(folder / "camera.toml"), read_tum(folder / TRUTH)
    first, second = (open_input(folder / "frames", RATE_HZ, chosen) for chosen in ranges)
    map_ = registered_map(first, camera, mapping, work / "map", trajectory=truth)
    row = {"registered": len(map_.keyframes), "landmarks": len(map_.landmarks)}
    recovery = replace(localizer.recovery, relocalize=True)
    settings = replace(localizer, recovery=recovery)
    return row | localized(map_, second, camera, settings, truth, told=False)
