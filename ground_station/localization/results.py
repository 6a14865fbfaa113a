"""What a run of the localizer leaves behind: a trajectory and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.localization.settings import LocalizerSettings


def trajectory(estimates: Sequence[PoseEstimate]) -> Trajectory:
    """The poses of the frames that were solved from their own observations."""
    solved = [(e.time_ns, e.wTc) for e in estimates if e.wTc is not None]
    return Trajectory.from_poses([t for t, _ in solved], [wTc for _, wTc in solved])


def write_estimates(path: str | Path, estimates: Sequence[PoseEstimate]) -> None:
    """Writes them as TUM text; no other poses."""
    write_tum(path, trajectory(estimates))


def percentiles(values_ms: Sequence[float]) -> dict[str, float]:
    """Median and 99th percentile, as `p50` and `p99`; empty when there are no values."""
    if not values_ms:
        return {}
    p50, p99 = np.percentile(values_ms, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}


def summary(
    estimates: Sequence[PoseEstimate], elapsed_s: float, settings: LocalizerSettings
) -> dict[str, Any]:
    """The figures of a run.

    `stage_ms` has each stage's median over the frames in which it ran, `stage_p99_ms` the 99th
    percentile; `latency_ms` is a frame's time from picture to pose, gated frames aside.
    """
    worked = [e for e in estimates if not e.gated]
    stages = dict.fromkeys(stage for e in estimates for stage in e.stage_ms)
    spans = {s: percentiles([e.stage_ms[s] for e in worked if s in e.stage_ms]) for s in stages}
    return {
        "frames": {
            "captured": len(estimates),
            "gated": sum(e.gated for e in estimates),
            "received": len(estimates),
            "localized": sum(e.localized for e in estimates),
        },
        "states": {state.value: sum(e.state is state for e in estimates) for state in State},
        "relocalized": sum(e.relocalized for e in estimates),
        "tracked": sum(e.tracked for e in estimates),
        "stage_ms": {stage: span["p50"] for stage, span in spans.items() if span},
        "stage_p99_ms": {stage: span["p99"] for stage, span in spans.items() if span},
        "latency_ms": percentiles([e.stage_ms["total"] for e in worked]),
        "rate_hz": round(len(estimates) / max(elapsed_s, 1e-9), 2),
        "seed": settings.seed,
        "settings": asdict(settings),
    }
