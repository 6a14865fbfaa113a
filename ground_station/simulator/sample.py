"""The sample that ships with the program: two flights, a floor plan and known points."""

from __future__ import annotations

from pathlib import Path

from ground_station.progress import Progress
from ground_station.simulator import scenes
from ground_station.simulator.floorplan import write_floorplan
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.simulate import SimulationSettings, simulate

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
