"""What a run of the localizer leaves behind: a trajectory and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.geometry.camera import Camera
from ground_station.geometry.trajectory import Trajectory, write_tum
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.observations import FlightObservations, landmarks_sha256
from ground_station.map.store import Map
from pi_firmware.wire.text import printable


def trajectory(estimates: Sequence[PoseEstimate]) -> Trajectory:
    """The poses of the frames that were solved from their own observations."""
    solved = [(e.time_ns, e.wTc) for e in estimates if e.wTc is not None]
    return Trajectory.from_poses([t for t, _ in solved], [wTc for _, wTc in solved])


def write_estimates(path: str | Path, estimates: Sequence[PoseEstimate]) -> None:
    """Writes them as TUM text; no other poses."""
    write_tum(path, trajectory(estimates))


def flight_observations(
    estimates: Sequence[PoseEstimate], name: str, map_: Map, camera: Camera
) -> FlightObservations:
    """What the frames of a flight saw of a map, for `blimp map refine`.

    The inliers of the frames that were tracking; a relocalization is not confirmed yet.
    """
    told = [
        (e.time_ns, e.wTc, e.observations)
        for e in estimates
        if e.wTc is not None and e.state is State.TRACKING and not e.relocalized
    ]
    landmark = [seen.landmark[seen.inlier] for _, _, seen in told]
    pixel_px = [seen.pixel_px[seen.inlier] for _, _, seen in told]
    ids = map_.landmarks.id[np.concatenate([*landmark, np.empty(0, np.intp)])]
    return FlightObservations(
        name=printable(name, 100, "_") or "flight",
        map=map_.info.name,
        landmarks_sha256=landmarks_sha256(map_.landmarks),
        camera=camera,
        time_ns=np.array([time_ns for time_ns, _, _ in told], np.int64),
        wTc=np.array([wTc for _, wTc, _ in told], np.float64).reshape(-1, 4, 4),
        offset=np.cumsum([0, *map(len, landmark)], dtype=np.int64),
        landmark=ids,
        pixel_px=np.concatenate([*pixel_px, np.empty((0, 2))]).astype(np.float32),
    )


def write_smoothed(path: str | Path, states: Sequence[Kinematics]) -> None:
    """Writes what later frames helped to estimate as TUM text: another file than the causal one."""
    ordered = sorted(states, key=lambda state: state.time_ns)
    times = [state.time_ns for state in ordered]
    write_tum(path, Trajectory.from_poses(times, [state.wTc for state in ordered]))


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
    stages = list(dict.fromkeys(stage for e in estimates for stage in e.stage_ms))
    stages.sort(key=lambda stage: stage == "total")  # the sum comes last
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
