"""The report of a flight: one self-contained HTML page, and the same figures as plain text.

The caller fills a `ReportData` with plain things; whatever is left out is left out of the page.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import U8
from ground_station.errors import GroundStationError
from ground_station.evaluation import plots
from ground_station.evaluation.ate import ALIGNMENTS
from ground_station.evaluation.figures import Row
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import load_floorplan
from ground_station.presentation.pages import Shown, data_uri, shown, write_page
from ground_station.presentation.text import columns, flat

_TEMPLATE = Path(__file__).parent / "templates" / "report.html"

_FRAME_MEANINGS = {
    "captured": "taken by the camera",
    "gated": "held back by the payload: too little to see in them",
    "discarded": "passed the gate, but never left the payload",
    "sent": "left the payload over the radio",
    "received": "arrived whole at the ground station",
    "lost": "sent, but never arrived whole",
    "dropped": "arrived, but skipped because newer ones were waiting",
    "localized": "solved from what is seen in them",
}
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
class MatchPicture:
    """A frame with its matches drawn (`draw_matches`), (H, W, 3) RGB uint8."""

    image: U8
    caption: str


@dataclass
class ReportData:
    """Everything on the page.

    `verdict`: a headline, then further lines. `frames`: captured, gated, sent, received, lost,
    localized (others are shown, too). `ate`: none, se3, sim3, each position_m, rotation_deg,
    position_zhang_m, or None where impossible. `stage_ms`: stage to p50 and p99, in order of the
    work. `latency_ms`: p50 and p99 from capture to pose. Times of the series are seconds from the
    first captured frame; `error_*` are (N,), `latency_*` (M,), NaN where there is nothing.
    `floorplan`: the path of a floorplan.yaml. `settings` may be nested.
    """

    title: str
    verdict: list[str]
    simulated: bool
    bounds: list[Row] = field(default_factory=list)
    frames: Mapping[str, int] = field(default_factory=dict)
    ate: Mapping[str, Mapping[str, float] | None] = field(default_factory=dict)
    stage_ms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    latency_ms: Mapping[str, float] | None = None
    rate_hz: float | None = None
    truth: Trajectory | None = None
    estimate: Trajectory | None = None
    error_time_s: npt.ArrayLike = ()
    error_position_m: npt.ArrayLike = ()
    error_rotation_deg: npt.ArrayLike = ()
    latency_time_s: npt.ArrayLike = ()
    latency_each_ms: npt.ArrayLike = ()
    position_limit_m: float | None = None
    rotation_limit_deg: float | None = None
    floorplan: Path | None = None
    pictures: list[MatchPicture] = field(default_factory=list)
    settings: Mapping[str, Any] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every bound is met."""
        return all(bound.holds for bound in self.bounds)

    @property
    def outcome(self) -> str:
        """The bounds in one line; empty without any."""
        missed = [bound.name for bound in self.bounds if not bound.holds]
        if missed:
            return f"{len(missed)} of {len(self.bounds)} bounds missed: {', '.join(missed)}"
        return f"All {len(self.bounds)} bounds met" if self.bounds else ""


def write_report(path: str | Path, data: ReportData) -> None:
    """Writes the page: no scripts, nothing fetched; beside and renamed.

    Raises `InputError` for a floor plan that cannot be read, `GroundStationError` for a page that
    cannot be written.
    """
    write_page(
        path,
        _TEMPLATE,
        title=data.title,
        data=data,
        frame_rows=_frame_rows(data.frames),
        ate_rows=_ate_rows(data.ate),
        time_rows=_time_rows(data),
        figures=_figures(data),
        pictures=[(_jpeg(picture.image), picture.caption) for picture in data.pictures],
        settings=flat(data.settings),
        legend=_LEGEND,
    )


def summary_table(data: ReportData) -> str:
    """The page's tables as aligned plain text for a console."""
    sections: list[tuple[str, list[list[str]]]] = [
        ("frames", [[n, c, s] for n, c, s, _ in _frame_rows(data.frames)]),
        ("error (RMSE)", [[n, p, r, z + " Zhang"] for n, p, r, z, _ in _ate_rows(data.ate)]),
        ("time, ms", [["", "median", "99th pct."], *map(list, _time_rows(data))]),
        (
            "bounds",
            [[b.name, b.measured, f"allowed: {b.allowed}", "met" if b.holds else "MISSED"]
             for b in data.bounds],
        ),
    ]  # fmt: skip
    lines = [data.title + (" (simulated flight)" if data.simulated else "")]
    for heading, rows in sections:
        if any(row[0] for row in rows):
            lines += ["", heading, *("  " + line for line in columns(rows))]
    lines += ["", *filter(None, [*data.verdict, data.outcome]), *data.notes]
    return "\n".join(lines)


def draw_matches(
    image: npt.ArrayLike,
    pixels: npt.ArrayLike,
    projected: npt.ArrayLike,
    residual_px: npt.ArrayLike,
) -> U8:
    """A frame (H, W) or (H, W, 3) with its matches, as (2H, 2W, 3) RGB.

    A ring marks each observed key point (N, 2), a line leads to where its landmark projects
    (N, 2); colours tell the residual (N,), px. Pairs that are not finite are left out.
    """
    grey: Any = np.asarray(image, dtype=np.uint8)
    rgb = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB) if grey.ndim == 2 else grey.copy()
    # Twice the size and a little darker, so that marks stand out without hiding what they mark.
    canvas = cv2.resize(rgb, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    canvas = cv2.convertScaleAbs(canvas, alpha=0.75)
    observed = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    expected = np.asarray(projected, dtype=np.float64).reshape(-1, 2)
    residuals = np.asarray(residual_px, dtype=np.float64).reshape(-1)
    finite = np.isfinite(observed).all(1) & np.isfinite(expected).all(1)
    near = finite & (np.abs(expected) < 1e5).all(1)
    for a, b, residual in zip(observed[near], expected[near], residuals[near], strict=True):
        colour = _GOOD if residual <= _GOOD_PX else _FAIR if residual <= _FAIR_PX else _POOR
        # Pixel centres are integers: u of the frame is 2u + 0.5 here; 4 bits are the fraction.
        start, end = (tuple(np.round((2 * p + 0.5) * 16).astype(int).tolist()) for p in (a, b))
        cv2.line(canvas, start, end, colour, 2, cv2.LINE_AA, shift=4)
        cv2.circle(canvas, start, 6 * 16, colour, 2, cv2.LINE_AA, shift=4)
    return np.asarray(canvas, dtype=np.uint8)


def _frame_rows(frames: Mapping[str, int]) -> list[tuple[str, str, str, str]]:
    """Name, count, share of the captured, meaning."""
    captured = frames.get("captured", 0)
    names = [name for name in _FRAME_MEANINGS if name in frames]
    names += [name for name in frames if name not in _FRAME_MEANINGS]
    return [
        (
            name,
            f"{frames[name]:,}".replace(",", " "),
            f"{frames[name] / captured:.1%}" if captured else "",
            _FRAME_MEANINGS.get(name, ""),
        )
        for name in names
    ]


def _ate_rows(
    ate: Mapping[str, Mapping[str, float] | None],
) -> list[tuple[str, str, str, str, str]]:
    """Alignment, position, rotation, Zhang's position, meaning."""
    rows = []
    for key in ALIGNMENTS:
        if key not in ate:
            continue
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


def _time_rows(data: ReportData) -> list[tuple[str, str, str]]:
    """Stage, median, 99th percentile, ms; capture to pose last."""
    stages = dict(data.stage_ms)
    if data.latency_ms is not None:
        stages["capture to pose"] = data.latency_ms
    return [(name, f"{t['p50']:.1f}", f"{t['p99']:.1f}") for name, t in stages.items()]


def _figures(data: ReportData) -> list[Shown]:
    figures: list[Shown] = []

    def add(heading: str, words: str, draw: Any) -> None:
        figures.append(shown(heading, words, draw))

    if data.estimate is not None or data.truth is not None:
        plan = load_floorplan(data.floorplan) if data.floorplan is not None else None
        add(
            "Path over the floor plan" if plan else "Path from above",
            "The true and the estimated path, seen from above",
            lambda theme: plots.trajectory_plot(data.truth, data.estimate, plan, theme),
        )
    if np.size(data.error_time_s):
        add(
            "Error over time, unaligned",
            "Position and rotation error of each localized frame over time",
            lambda theme: plots.error_plot(
                data.error_time_s,
                data.error_position_m,
                data.error_rotation_deg,
                position_limit_m=data.position_limit_m,
                rotation_limit_deg=data.rotation_limit_deg,
                theme=theme,
            ),
        )
    if np.size(data.latency_time_s):
        latency = data.latency_ms or {}
        add(
            "Latency over time, capture to pose",
            "The time from capture to pose of each localized frame",
            lambda theme: plots.latency_plot(
                data.latency_time_s,
                data.latency_each_ms,
                median_ms=latency.get("p50"),
                p99_ms=latency.get("p99"),
                theme=theme,
            ),
        )
    return figures


def _jpeg(image: U8) -> str:
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not ok:
        raise GroundStationError("report: a match picture cannot be encoded")
    return data_uri("jpeg", data.tobytes())
