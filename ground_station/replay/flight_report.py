"""A replay's result as results.json, as the pilot's table, and as report.html."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.evaluation.figures import AT_LEAST, AT_MOST, Row
from ground_station.evaluation.report import MatchPicture, ReportData, draw_matches
from ground_station.geometry import poses
from ground_station.map.store import Map
from ground_station.replay.replay import ReplayResult
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.localizing.derive import estimate_of


def report_data(
    title: str,
    result: ReplayResult,
    map_: Map,
    *,
    bounds: Sequence[Row] = (),
    simulated: bool,
    floorplan: Path | None,
    seeds: dict[str, int],
) -> ReportData:
    """What the page and the table show of a replay, judged by `bounds`."""
    accounts = result.live.accounts()
    frames = result.live.frames
    start_ns = min((frame.estimate.time_ns for frame in frames), default=0)
    latency = result.live.latency_ms()
    errors = result.evaluation.errors["none"] if result.evaluation else None
    error_ns = result.evaluation.truth.time_ns if result.evaluation else np.empty(0)
    limits = {bound.name: bound.bound for bound in bounds}
    document = result.document()
    return ReportData(
        title=title,
        verdict=[f"{accounts['localized']} of {accounts['captured']} captured frames localized."],
        simulated=simulated,
        bounds=list(bounds),
        frames=accounts,
        ate=document["ate"] or {},
        stage_ms={
            stage: {"p50": p50, "p99": document["stage_p99_ms"][stage]}
            for stage, p50 in document["stage_ms"].items()
        },
        latency_ms=document["latency_ms"] or None,
        rate_hz=document["rate_hz"],
        truth=_within(result),
        estimate=result.estimate if len(result.estimate) else None,
        error_time_s=(error_ns - start_ns) / 1e9,
        error_position_m=errors.position_m if errors else (),
        error_rotation_deg=errors.rotation_deg if errors else (),
        latency_time_s=[(frame.estimate.time_ns - start_ns) / 1e9 for frame in frames],
        latency_each_ms=latency,
        position_limit_m=limits.get(POSITION),
        rotation_limit_deg=limits.get(ROTATION),
        floorplan=floorplan,
        pictures=[_picture(image, note, result, map_) for image, note in result.live.pictures],
        settings={
            "replay": {k: str(v) for k, v in asdict(result.settings).items() if k != "recording"}
            | {"recording": result.settings.recording.name},
            "map": {
                "images": map_.info.built.get("registered"),
                "landmarks": len(map_.landmarks),
                "registration": map_.info.registration.get("method", "none"),
                "held_out_rms_m": map_.info.registration.get("held_out_rms_m"),
            },
            "localizer": asdict(result.localizer),
            "camera": result.camera.as_dict(),
        },
        seeds=seeds,
        notes=notes(result),
    )


POSITION = "position error, unaligned, RMSE"
ROTATION = "rotation error, unaligned, RMSE"
GATED = "frames gated, of those captured"
LOCALIZED = "frames localized, of those taken"
"""Taken: neither gated nor overtaken by a newer frame, as they are where a machine is too slow."""


def notes(result: ReplayResult) -> list[str]:
    """What a reader must know besides the figures."""
    lines = []
    if result.settings.init == "truth":
        lines.append("The first frame's pose was given, as the thesis needs it: the true one.")
    clock = result.live.clock
    if clock is None:
        lines.append("The payload's clock never answered: latencies take both clocks for one.")
    else:
        lines.append(f"Latencies are exact to {clock['uncertainty_ns'] / 1e6:.2f} ms.")
    if dropped := result.live.accounts()["dropped"]:
        lines.append(
            f"{dropped} frames were skipped for newer ones: this computer was too slow for"
            f" {result.settings.rate_hz:g} Hz, by itself or because of what else it did."
        )
    if not result.live.complete:
        lines.append("The payload's final counts did not arrive: frames sent is what was received.")
    return lines


def judge(result: ReplayResult, limits: dict[str, float]) -> list[Row]:
    """The bounds with what was measured. `limits` by the names above; shares in per cent."""
    accounts = result.live.accounts()
    captured, gated = accounts["captured"], accounts["gated"]
    rmse = result.evaluation.errors["none"].rmse() if result.evaluation else {}
    taken = captured - gated - accounts["dropped"]
    values = {
        GATED: (100 * gated / captured if captured else None, "%", AT_MOST),
        LOCALIZED: (100 * accounts["localized"] / taken if taken else None, "%", AT_LEAST),
        POSITION: (rmse.get("position_m"), "m", AT_MOST),
        ROTATION: (rmse.get("rotation_deg"), "°", AT_MOST),
    }
    return [
        Row.bounded(name, *values[name][:2], limit, values[name][2])
        for name, limit in limits.items()
    ]


def _within(result: ReplayResult) -> Any:
    """The truth between the first and the last received frame: the part that was flown here."""
    if result.truth is None or not result.live.frames:
        return result.truth
    times = [frame.estimate.time_ns for frame in result.live.frames]
    truth = result.truth
    keep = (truth.time_ns >= min(times)) & (truth.time_ns <= max(times))
    return truth[keep]


def _picture(image: Any, note: EstimateMessage, result: ReplayResult, map_: Map) -> MatchPicture:
    wTc = estimate_of(note, 0).wTc
    pixel_px = projected = np.empty((0, 2))
    if wTc is not None:
        pixel_px = np.array(note.points_px).reshape(-1, 2)
        points = map_.landmarks.position_m[note.landmarks]
        projected = result.camera.project(poses.transform(poses.inverse(wTc), points))
    caption = f"frame {note.sequence}: {note.state}"
    if note.reason:
        caption += f" ({note.reason})"
    caption += f", {note.inliers} inliers of {note.expected} landmarks in view"
    residual_px = np.linalg.norm(pixel_px - projected, axis=1)
    return MatchPicture(draw_matches(image, pixel_px, projected, residual_px), caption)
