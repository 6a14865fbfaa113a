"""Bounds proposed from a run: what it measured and a stated margin; a person decides."""

from __future__ import annotations

import math

from ground_station.evaluation.figures import AT_LEAST, digits
from ground_station.replay.cases.limits import BOUNDS, Limits
from ground_station.replay.cases.measure import Figure
from pi_firmware.wire.config import range_of

MARGINS = {
    "coverage_min": (0.0, 0.05),
    "tracking_min": (0.0, 0.05),
    "lost_max": (0.0, 0.02),
    "position_rmse_m_max": (0.5, 0.005),
    "rotation_rmse_deg_max": (0.5, 0.05),
    "position_max_m": (0.5, 0.02),
    "latency_p50_ms_max": (1.0, 10.0),
    "latency_p99_ms_max": (1.0, 50.0),
    "recovery_s_max": (0.5, 0.5),
    "payload_memory_MB_max": (0.25, 0.0),
    "ground_memory_MB_max": (0.25, 0.0),
    "payload_cpu_max": (0.5, 0.0),
}
"""What is left between a measured value and its bound: a share of it, and a fixed part.

The cell's voltage has none: what is healthy is no matter of one run."""


def propose(figures: dict[str, Figure]) -> tuple[dict[str, float], dict[str, str]]:
    """Bounds of what was measured, by name, and for each a remark that says how it came about."""
    bounds: dict[str, float] = {}
    remarks: dict[str, str] = {}
    for name, figure_name, _, sense in BOUNDS:
        value = figures[figure_name].value
        if name not in MARGINS or value is None or not math.isfinite(value):
            continue
        share, fixed = MARGINS[name]
        room = share * abs(value) + fixed
        bound = value - room if sense == AT_LEAST else value + room
        outward = _outward(max(0.0, bound), down=sense == AT_LEAST)
        bounds[name] = min(outward, range_of(Limits, name)[1])
        parts = [f"{share:.0%} of it"] * (share > 0) + [f"{fixed:g}"] * (fixed > 0)
        remarks[f"bounds.{name}"] = (
            f"Measured {digits(value, None)}; the margin is {' and '.join(parts)}."
        )
    return bounds, remarks


def _outward(value: float, *, down: bool) -> float:
    """Rounded to two digits, away from what was measured."""
    if value == 0:
        return 0.0
    scale = 10.0 ** (math.floor(math.log10(abs(value))) - 1)
    whole = math.floor(value / scale) if down else math.ceil(value / scale)
    return float(f"{whole * scale:.6g}")
