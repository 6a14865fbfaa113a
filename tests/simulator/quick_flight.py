"""A flight that takes seconds."""

from __future__ import annotations

from pathlib import Path

from ground_station.simulator.simulate import SimulationSettings


def quick_settings(out: Path, **changes: object) -> SimulationSettings:
    """A flight that takes seconds: coarse textures, small renders, few frames."""
    values: dict[str, object] = {
        "out": out, "plan": "loop", "light": "noon", "seed": 5, "duration_s": 0.8, "rate_hz": 5.0,
        "texels_per_m": 12.0, "supersampling": 0.5, "renders": 1,
    }  # fmt: skip
    return SimulationSettings(**(values | changes))  # type: ignore[arg-type]
