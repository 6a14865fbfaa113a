"""Outcomes made by hand, with errors that are known, and small recordings that nobody decodes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import PoseEstimate, State
from ground_station.replay.cases import frames
from ground_station.replay.cases.outcome import Accounts, Outcome, Run
from ground_station.replay.live import LiveFrame
from ground_station.replay.resources import Side
from pi_firmware.wire.messages import Battery, Health
from pi_firmware.wire.recording import ESTIMATE_TOPIC, TRUTH_TOPIC, RecordingWriter

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium"
STEP_NS = 33_333_333
START_NS = 5_000_000_000
CLOCK_NS = 1_700_000_000_000_000_000
"""The ground's clock when the camera's says `START_NS`."""
UNIT = b"\0\0\0\1\x65"
"""How each access unit of such a recording begins."""


def true_pose(k: int) -> F64:
    """Of frame k: along x at 3 cm a frame, turning by 1° a frame."""
    angle = np.radians(k)
    c, s = np.cos(angle), np.sin(angle)
    return poses.pose([[c, -s, 0], [s, c, 0], [0, 0, 1]], [1.0 + 0.03 * k, 2.0, 1.5])


def truth(n: int = 60) -> Trajectory:
    """The true poses of n frames."""
    times = [START_NS + k * STEP_NS for k in range(n)]
    return Trajectory.from_poses(times, [true_pose(k) for k in range(n)])


def row(k: int, **changes: Any) -> LiveFrame:
    """Frame k, TRACKING in its true place, 40 ms after its capture."""
    taken_ns = CLOCK_NS + k * STEP_NS
    captured_ns = changes.pop("captured_ns", taken_ns)
    sequence = changes.pop("sequence", k)
    done_ns = changes.pop("done_ns", taken_ns + 40_000_000)
    usual: dict[str, Any] = {"time_ns": START_NS + k * STEP_NS, "wTc": true_pose(k)}
    state = State(changes.pop("state", "TRACKING"))
    estimate = PoseEstimate(index=k, state=state, **(usual | changes))
    return LiveFrame(sequence, taken_ns, taken_ns + 15_000_000, done_ns, estimate, captured_ns)


def table(rows: Sequence[LiveFrame]) -> frames.Frames:
    """Of frames made so."""
    return frames.table(rows, [int(row.capture_ns or 0) for row in rows])


def off(k: int, dx_m: float, **changes: Any) -> LiveFrame:
    """Frame k, that far off its true place along y."""
    wTc = true_pose(k)
    wTc[1, 3] += dx_m
    return row(k, wTc=wTc, **changes)


def outcome(rows: Sequence[LiveFrame] | None = None, **changes: Any) -> Outcome:
    """A run of which nothing was lost; `changes` are of `Run`, `accounts` of some of its counts."""
    made = table([row(k) for k in range(60)] if rows is None else rows)
    n, localized = len(made), int(made.localized.sum())
    counts = {"captured": n, "sent": n, "received": n, "localized": localized}
    usual: dict[str, Any] = {
        "title": "by hand",
        "recording": "flight.mcap",
        "map": "atrium",
        "complete": True,
        "accounts": Accounts(**(counts | changes.pop("accounts", {}))),
        "stream": {"access_units": n},
        "battery": Battery(1, 3.9, percentage=0.7),
        "health": Health(1, 3.0, cpu=0.2, memory_MB=60.0),
        "refused": 0,
        "payload_side": Side(80.0, 0.3, "/proc"),
        "ground_side": Side(300.0, 0.9, "/proc"),
        "settings": {"localizer": {"seed": 1}},
        "versions": {"ground_station": "0.1.0"},
    }
    return Outcome(Run(**(usual | changes)), made, truth(n) if n else None)


def only(made: Outcome, keep: Sequence[int]) -> Outcome:
    """The same run with only these frames in its table."""
    fields = {}
    for item in dataclasses.fields(made.frames):
        column = getattr(made.frames, item.name)
        is_array = isinstance(column, np.ndarray)
        fields[item.name] = column[list(keep)] if is_array else tuple(column[k] for k in keep)
    return dataclasses.replace(made, frames=frames.Frames(**fields))


def recording(
    path: Path,
    n: int = 30,
    *,
    payloads: Sequence[str] = (),
    calibrated: bool = True,
    true_poses: bool = True,
    estimates: bool = False,
    chunk_bytes: int = 2000,
) -> Path:
    """A recording of n frames; with `payloads` as a ground station writes one of several."""
    prefixes = {name: f"/{name}" if k else "" for k, name in enumerate(payloads)} or {"": ""}
    with RecordingWriter(path, chunk_bytes=chunk_bytes) as writer:
        writer.write_metadata("camera", {"readout_s": "0.02"})
        for name, prefix in prefixes.items():
            if name:
                table = f"payload {name}" if prefix else "payload"
                writer.write_metadata(table, {"payload_id": name, "topics": prefix})
            if calibrated:
                writer.write_calibration(
                    START_NS,
                    width_px=64,
                    height_px=48,
                    matrix=[50, 0, 31, 0, 50, 23, 0, 0, 1],
                    distortion=[0, 0, 0, 0, 0],
                    topic=f"{prefix}/camera/calibration",
                )
        for k in range(n):
            time_ns = START_NS + k * STEP_NS
            for prefix in prefixes.values():
                unit = UNIT + bytes([k % 256]) * 90
                log_ns = CLOCK_NS + k * STEP_NS
                topic = f"{prefix}/camera/video"
                writer.write_video(time_ns, unit, topic=topic, log_ns=log_ns)
                writer.write_json(
                    f"{prefix}/camera/frame", log_ns, {"sequence": k}, schema_name="blimp.Frame"
                )
                place = ((1.0 + 0.03 * k, 2.0, 1.5), (0.0, 0.0, 0.0, 1.0))
                for topic, wanted in ((TRUTH_TOPIC, true_poses), (ESTIMATE_TOPIC, estimates)):
                    if wanted:
                        writer.write_pose(time_ns, *place, topic=prefix + topic, log_ns=log_ns)
    return path
