"""A flight that takes seconds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ground_station.simulator import command, lighting, textures
from ground_station.simulator.simulate import SimulationSettings


@contextmanager
def quick_light() -> Iterator[pytest.MonkeyPatch]:
    """Smaller fields for textures, light from fewer directions and in a coarser map of the sun."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textures, "_FIELD_SIZE", 256)
        patch.setattr(lighting, "_SKY_DIRECTIONS", 8)
        patch.setattr(lighting, "_SUN_MAP_PX", 1024)
        yield patch


def quick_settings(out: Path, **changes: object) -> SimulationSettings:
    """A flight that takes seconds: coarse textures, small renders, few frames."""
    values: dict[str, object] = {
        "out": out, "plan": "loop", "light": "noon", "seed": 5, "duration_s": 0.8, "rate_hz": 5.0,
        "texels_per_m": 12.0, "supersampling": 0.5, "renders": 1,
    }  # fmt: skip
    return SimulationSettings(**(values | changes))  # type: ignore[arg-type]


def arguments(*words: str) -> argparse.Namespace:
    """What `blimp simulate` is told."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(words)


def asked_for(*words: str) -> SimulationSettings:
    """The settings that these words make."""
    return command.settings_from(arguments("--out", "f.mcap", *words))
