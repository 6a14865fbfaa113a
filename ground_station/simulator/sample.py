"""The sample that ships with the program: two flights, a floor plan and known points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

from ground_station.arrays import U8
from ground_station.files import write_bytes
from ground_station.progress import Progress
from ground_station.simulator import scenes
from ground_station.simulator.scene import Footprint, Scene, SimulatorError
from ground_station.simulator.simulate import SimulationSettings, simulate

_RESOLUTION_M = 0.025
_MARGIN_M = 0.75
_FREE, _UNKNOWN, _OCCUPIED = 254, 205, 0
# What a wheel or an ankle meets is occupied; stairs and the balcony's edge are drawn as lines.
_FILLED = ("wall", "pillar", "furniture", "glass")


def draw_floorplan(scene: Scene) -> U8:
    """The plan (H, W), 254 free, 0 occupied, 205 unknown; rows go down as y falls."""
    width, height = (
        round((s + 2 * _MARGIN_M) / _RESOLUTION_M) for s in (scene.size_m[0], scene.size_m[1])
    )
    plan = np.full((height, width), _UNKNOWN, np.uint8)

    def corner(x_m: float, y_m: float) -> tuple[int, int]:
        column = round((x_m + _MARGIN_M) / _RESOLUTION_M)
        return column, height - round((y_m + _MARGIN_M) / _RESOLUTION_M)

    def fill(f: Footprint, value: int) -> None:
        (left, bottom), (right, top) = corner(*f.bounds_m[:2]), corner(*f.bounds_m[2:])
        if f.disc:
            centre = ((left + right) // 2, (top + bottom) // 2)
            cv2.circle(plan, centre, (right - left) // 2, value, -1)
        else:
            plan[max(0, top) : bottom, max(0, left) : right] = value

    hall = Footprint((0.0, 0.0, scene.size_m[0], scene.size_m[1]), "floor")
    fill(hall, _FREE)
    for f in scene.footprints:
        if f.kind in _FILLED:
            fill(f, _OCCUPIED)
        elif f.kind == "stairs":
            (left, bottom), (right, top) = corner(*f.bounds_m[:2]), corner(*f.bounds_m[2:])
            for y in np.linspace(top, bottom, 21).round().astype(int).tolist():
                cv2.line(plan, (left, y), (right, y), _OCCUPIED, 1)
            cv2.rectangle(plan, (left, top), (right, bottom), _OCCUPIED, 1)
        elif f.kind == "balcony":  # its edge is overhead: dashed
            (left, bottom), (right, _) = corner(*f.bounds_m[:2]), corner(*f.bounds_m[2:])
            for x in range(left, right, 16):
                cv2.line(plan, (x, bottom), (min(x + 7, right), bottom), _UNKNOWN, 2)
    return plan


def write_floorplan(folder: str | Path, scene: Scene) -> list[Path]:
    """Writes `floorplan.png` and `floorplan.yaml`, each beside and renamed; returns their paths."""
    folder = Path(folder)
    _, png = cv2.imencode(".png", draw_floorplan(scene), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    document = {
        "image": "floorplan.png",
        "resolution": _RESOLUTION_M,
        # The world pose (x, y, yaw) of the lower left corner of the lower left pixel.
        "origin": [-_MARGIN_M, -_MARGIN_M, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    write_bytes(folder / "floorplan.png", png.tobytes())
    write_bytes(folder / "floorplan.yaml", yaml.safe_dump(document, sort_keys=False).encode())
    return [folder / "floorplan.png", folder / "floorplan.yaml"]


MAX_FILE_BYTES = 6_000_000
_TEXELS_PER_M = 150.0


def sample_settings(folder: Path) -> tuple[SimulationSettings, SimulationSettings]:
    """The mapping flight, a picture every 0.8 s, and the localization flight at 30 Hz."""
    mapping = SimulationSettings(
        out=folder / "mapping.mcap", plan="mapping", light="noon", seed=11, rate_hz=1.25, crf=24.5,
        points=folder / "PAIRS.csv", texels_per_m=_TEXELS_PER_M,
    )  # fmt: skip
    flight = SimulationSettings(
        out=folder / "flight.mcap", plan="loop", light="noon", seed=29, rate_hz=30.0, crf=23.0,
        duration_s=32.0, texels_per_m=_TEXELS_PER_M,
    )  # fmt: skip
    return mapping, flight


def make_sample(folder: str | Path) -> list[Path]:
    """Writes the sample into a folder from fixed seeds; returns the files.

    Raises `SimulatorError` when a flight was
    interrupted or a file is larger than what the repository takes.
    """
    folder = Path(folder)
    made = []
    for settings in sample_settings(folder):
        with Progress(f"{settings.out.name}, frames", None) as progress:
            result = simulate(settings, lambda done, total: progress.step(total))
        if result.interrupted:
            raise SimulatorError(f"interrupted: {settings.out} is shorter than the sample's")
        if result.bytes > MAX_FILE_BYTES:
            raise SimulatorError(
                f"{settings.out} has {result.bytes} bytes; allowed: {MAX_FILE_BYTES}"
            )
        made.append(settings.out)
        if settings.points is not None:
            made.append(settings.points)
    return made + write_floorplan(folder, scenes.build("atrium", _TEXELS_PER_M))
