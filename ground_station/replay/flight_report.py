"""The report of a replay: its results.json and its outcome as a page, and as the pilot's table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64, U8
from ground_station.evaluation.ate import ALIGNMENTS
from ground_station.evaluation.figures import AT_LEAST, AT_MOST, Row
from ground_station.files import write_json
from ground_station.geometry import poses
from ground_station.map.store import Map
from ground_station.presentation.pages import data_uri, write_page
from ground_station.presentation.text import columns, flat
from ground_station.replay.cases import page
from ground_station.replay.cases.outcome import Accounts, Outcome, write_outcome
from ground_station.replay.cases.taken import outcome_of
from ground_station.replay.replay import ReplayResult
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.localizing.derive import estimate_of
from pi_firmware.wire.recording import RecordingReader

POSITION = "position error, unaligned, RMSE"
ROTATION = "rotation error, unaligned, RMSE"
GATED = "frames gated, of those captured"
LOCALIZED = "frames localized, of those taken"
"""Taken: neither gated nor overtaken by a newer frame, as they are where a machine is too slow."""

OUTCOME = "outcome"
"""The folder beside the page with every frame, which --accept and --compare take."""
_TEMPLATE = Path(__file__).parent / "templates" / "report.html"
_MEANINGS = {item.name: item.metadata["doc"] for item in fields(Accounts)}
_ALIGNMENT_MEANINGS = {
    "none": ("unaligned", "as flown: what an autopilot would get"),
    "se3": ("SE(3)", "moved and turned as a whole onto the truth"),
    "sim3": ("Sim(3)", "moved, turned and scaled as a whole"),
}
_GOOD_PX, _FAIR_PX = 2.0, 5.0
_GOOD, _FAIR, _POOR = (86, 180, 233), (240, 228, 66), (213, 94, 0)  # Okabe and Ito, RGB
_LEGEND = [
    ("#" + bytes(_GOOD).hex(), f"at most {_GOOD_PX:g} px"),
    ("#" + bytes(_FAIR).hex(), f"at most {_FAIR_PX:g} px"),
    ("#" + bytes(_POOR).hex(), "more"),
]


@dataclass(frozen=True)
class FlightReport:
    """Everything on the page.

    `document` is as results.json holds it, `outcome` the same run with its frames; `pictures` are
    frames with their matches drawn, (H, W, 3) RGB uint8, each with words. `settings` may be nested.
    """

    title: str
    document: dict[str, Any]
    outcome: Outcome
    simulated: bool
    bounds: Sequence[Row] = ()
    pictures: Sequence[tuple[U8, str]] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @property
    def verdict(self) -> str:
        """How much was localized."""
        frames = self.document["frames"]
        return f"{frames['localized']} of {frames['captured']} captured frames localized."

    @property
    def passed(self) -> bool:
        """Whether every bound is met."""
        return all(bound.holds for bound in self.bounds)

    @property
    def judgement(self) -> str:
        """The bounds in one line; empty without any."""
        missed = [bound.name for bound in self.bounds if not bound.holds]
        if missed:
            return f"{len(missed)} of {len(self.bounds)} bounds missed: {', '.join(missed)}"
        return f"All {len(self.bounds)} bounds met" if self.bounds else ""


def report_of(
    title: str,
    result: ReplayResult,
    map_: Map,
    *,
    seconds: float,
    bounds: Sequence[Row] = (),
    seeds: Mapping[str, int],
) -> FlightReport:
    """The report of a replay in `map_` that took so long, judged by `bounds`."""
    recording = result.settings.recording
    outcome = outcome_of(result, map_, seconds=seconds)
    return FlightReport(
        title,
        result.document(),
        outcome,
        simulated=bool(RecordingReader(recording).metadata_table("simulation")),
        bounds=bounds,
        pictures=[_picture(image, note, result, map_) for image, note in result.live.pictures],
        settings={
            "recording": recording.name,
            "map": {
                "images": map_.info.built.get("registered"),
                "landmarks": len(map_.landmarks),
                "registration": map_.info.registration.get("method", "none"),
                "held_out_rms_m": map_.info.registration.get("held_out_rms_m"),
            },
            **outcome.run.settings,
        },
        seeds=seeds,
        notes=notes(result),
    )


def publish(out: Path, report: FlightReport, **more: Any) -> None:
    """Writes results.json with `more` in it, report.html and the outcome to a folder; prints.

    Raises `GroundStationError` where the disk refuses.
    """
    write_json(out / "results.json", report.document | more)
    write_report(out / "report.html", report)
    write_outcome(out / OUTCOME, report.outcome)
    print(summary_table(report))
    print(f"\n{out / 'report.html'}\n{out / 'results.json'}")


def write_report(path: Path, report: FlightReport) -> None:
    """Writes the page: no scripts, nothing fetched; beside and renamed."""
    document, outcome = report.document, report.outcome
    limits = {bound.name: bound.bound for bound in report.bounds}
    write_page(
        path,
        _TEMPLATE,
        title=report.title,
        report=report,
        bound_rows=[
            (b.name, b.measured, b.allowed, "✓ met" if b.holds else "✗ missed")
            for b in report.bounds
        ],
        frame_rows=_frame_rows(document["frames"]),
        ate_rows=_ate_rows(document["ate"] or {}),
        time_rows=_time_rows(document),
        figures=page.of_run(
            outcome,
            outcome.truth,
            position_m=limits.get(POSITION),
            rotation_deg=limits.get(ROTATION),
        ),
        pictures=[(_jpeg(image), caption) for image, caption in report.pictures],
        settings=[
            *((f"seed: {name}", seed) for name, seed in report.seeds.items()),
            *flat(report.settings).items(),
        ],
        legend=_LEGEND,
    )


def summary_table(report: FlightReport) -> str:
    """The page's tables as aligned plain text for a console."""
    document = report.document
    sections: list[tuple[str, list[list[str]]]] = [
        ("frames", [[n, c, s] for n, c, s, _ in _frame_rows(document["frames"])]),
        ("error (RMSE)", [[n, p, r, z + " Zhang"]
                          for n, p, r, z, _ in _ate_rows(document["ate"] or {})]),
        ("time, ms", [["", "median", "99th pct."], *map(list, _time_rows(document))]),
        (
            "bounds",
            [[b.name, b.measured, f"allowed: {b.allowed}", "met" if b.holds else "MISSED"]
             for b in report.bounds],
        ),
    ]  # fmt: skip
    lines = [report.title + (" (simulated flight)" if report.simulated else "")]
    for heading, rows in sections:
        if any(row[0] for row in rows):
            lines += ["", heading, *("  " + line for line in columns(rows))]
    lines += ["", *filter(None, [report.verdict, report.judgement]), *report.notes]
    return "\n".join(lines)


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
    values = (
        (GATED, 100 * gated / captured if captured else None, "%", AT_MOST),
        (LOCALIZED, 100 * accounts["localized"] / taken if taken else None, "%", AT_LEAST),
        (POSITION, rmse.get("position_m"), "m", AT_MOST),
        (ROTATION, rmse.get("rotation_deg"), "°", AT_MOST),
    )
    return [
        Row.bounded(name, value, unit, limits[name], sense)
        for name, value, unit, sense in values
        if name in limits
    ]


def draw_matches(image: U8, observed_px: F64, expected_px: F64) -> U8:
    """A grey frame (H, W) with its matches, as (2H, 2W, 3) RGB.

    A ring marks each observed key point (N, 2), a line leads to where its landmark projects
    (N, 2), far off or NaN where it is left out; colours tell how far apart they are.
    """
    # Twice the size and a little darker, so that marks stand out without hiding what they mark.
    canvas = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    canvas = cv2.convertScaleAbs(cv2.cvtColor(canvas, cv2.COLOR_GRAY2RGB), alpha=0.75)
    near = (np.abs(expected_px) < 1e5).all(axis=1)
    for a, b in zip(observed_px[near], expected_px[near], strict=True):
        apart_px = np.linalg.norm(b - a)
        colour = _GOOD if apart_px <= _GOOD_PX else _FAIR if apart_px <= _FAIR_PX else _POOR
        # Pixel centres are integers: u of the frame is 2u + 0.5 here; 4 bits are the fraction.
        start, end = (tuple(np.round((2 * p + 0.5) * 16).astype(int).tolist()) for p in (a, b))
        cv2.line(canvas, start, end, colour, 2, cv2.LINE_AA, shift=4)
        cv2.circle(canvas, start, 6 * 16, colour, 2, cv2.LINE_AA, shift=4)
    return np.asarray(canvas, dtype=np.uint8)


def _picture(image: U8, note: EstimateMessage, result: ReplayResult, map_: Map) -> tuple[U8, str]:
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
    return draw_matches(image, pixel_px, projected), caption


def _frame_rows(frames: Mapping[str, int]) -> list[tuple[str, str, str, str]]:
    """Name, count, share of the captured, meaning."""
    captured = frames["captured"]
    return [
        (
            name,
            f"{count:,}".replace(",", " "),
            f"{count / captured:.1%}" if captured else "",
            _MEANINGS[name],
        )
        for name, count in frames.items()
    ]


def _ate_rows(
    ate: Mapping[str, Mapping[str, float] | None],
) -> list[tuple[str, str, str, str, str]]:
    """Alignment, position, rotation, Zhang's position, meaning."""
    rows = []
    for key in ALIGNMENTS if ate else ():
        name, meaning = _ALIGNMENT_MEANINGS[key]
        values = ate[key]
        if values is None:
            rows.append((name, "—", "—", "—", "the path does not determine it"))
            continue
        position, zhang = values["position_m"], values["position_zhang_m"]
        rows.append(
            (name, f"{position:.4f} m", f"{values['rotation_deg']:.3f}°", f"{zhang:.4f} m", meaning)
        )
    return rows


def _time_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Stage, median, 99th percentile, ms; capture to pose last."""
    p99_ms = document["stage_p99_ms"]
    rows = [(name, f"{p50:.1f}", f"{p99_ms[name]:.1f}")
            for name, p50 in document["stage_ms"].items()]  # fmt: skip
    if latency := document["latency_ms"]:
        rows.append(("capture to pose", f"{latency['p50']:.1f}", f"{latency['p99']:.1f}"))
    return rows


def _jpeg(image: U8) -> str:
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    return data_uri("jpeg", data.tobytes())
