"""The calibration's page: one HTML file, nothing fetched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from ground_station.calibration import results
from ground_station.calibration.board import Board
from ground_station.calibration.calibrate import Result
from ground_station.calibration.selection import CORNER_SHARE
from ground_station.calibration.views import View
from ground_station.presentation.pages import themed_figure, write_page
from ground_station.presentation.theme import Theme, sheet, themed

WIDTH_IN = 6.6
_SMALL = 8.5
_ARROW_SHARE = 0.02
"""Of the width: how long a residual of usual size is drawn."""


def coverage(result: Result, theme: Theme) -> Figure:
    """All corners that count, in the picture; its four corners are framed."""
    figure, axes = _picture(result, theme)
    for k, (view, kept) in enumerate(zip(result.views, result.fit.used, strict=True)):
        px = view.seen.px
        label = "corner of the board" if k == 0 else None
        axes.plot(*px[kept].T, ".", color=theme.estimate, ms=2.5, label=label)
        if not kept.all():
            axes.plot(*px[~kept].T, "x", color=theme.second, ms=5, mew=1.2)
    if result.corners[1]:
        axes.plot([], [], "x", color=theme.second, ms=5, mew=1.2, label="left out as wrong")
    _legend(axes, theme)
    return figure


def magnification(result: Result) -> float:
    """How many times longer residuals are drawn: a round number."""
    usual = max(result.fit.rms_px, 1e-3)
    power = 10 ** np.floor(np.log10(_ARROW_SHARE * result.size_px[0] / usual))
    times = _ARROW_SHARE * result.size_px[0] / usual / power
    return float(power * (5 if times >= 5 else 2 if times >= 2 else 1))


def residuals(result: Result, theme: Theme) -> Figure:
    """From where the lens puts each corner to where it was seen, magnified."""
    figure, axes = _picture(result, theme)
    px, off = result.residuals()
    axes.quiver(
        *px.T, *(off * magnification(result)).T, angles="xy", scale_units="xy", scale=1,
        width=0.0014, headwidth=4, color=theme.estimate,
    )  # fmt: skip
    return figure


def per_view(result: Result, theme: Theme) -> Figure:
    """The RMS of each view, in order of the inputs, and the median."""
    figure = sheet((WIDTH_IN, 2.6), theme)
    axes = figure.subplots()
    themed(axes, theme, _SMALL)
    values = [rms for _, rms, _, _ in _in_order(result)]
    axes.bar(np.arange(1, len(values) + 1), values, color=theme.estimate, width=0.75)
    axes.axhline(float(np.median(values)), color=theme.limit, ls="--", lw=1.2, label="median")
    axes.set_xlabel("view", fontsize=_SMALL)
    axes.set_ylabel("RMS, px", fontsize=_SMALL)
    axes.set_xlim(0.4, len(values) + 0.6)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(False, axis="x")
    _legend(axes, theme)
    return figure


def _in_order(result: Result) -> list[tuple[View, float, float, float]]:
    """The result's rows in the order of the inputs."""
    return sorted(result.rows(), key=lambda row: (row[0].seen.source, row[0].seen.index))


def _picture(result: Result, theme: Theme) -> tuple[Figure, Axes]:
    w, h = result.size_px
    figure = sheet((WIDTH_IN, 0.5 + 6.0 * h / w), theme)
    axes = figure.subplots()
    themed(axes, theme, _SMALL)
    axes.set_aspect("equal")
    axes.set_xlim(-0.01 * w, 1.01 * w)
    axes.set_ylim(1.01 * h, -0.01 * h)
    axes.add_patch(Rectangle((0, 0), w - 1, h - 1, fill=False, edgecolor=theme.ink, lw=0.8))
    wide, high = CORNER_SHARE * w, CORNER_SHARE * h
    for x in (0, w - wide):
        for y in (0, h - high):
            axes.add_patch(
                Rectangle((x, y), wide, high, fill=False, edgecolor=theme.limit, lw=0.8, ls=":")
            )
    axes.set_xlabel("u, px", fontsize=_SMALL)
    axes.set_ylabel("v, px", fontsize=_SMALL)
    return figure, axes


def _legend(axes: Axes, theme: Theme) -> None:
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False,
        labelcolor=theme.ink, fontsize=_SMALL, borderaxespad=0.2,
    )  # fmt: skip


_TEMPLATE = Path(__file__).parent / "calibration.html"


def write_report(
    path: str | Path, result: Result, board: Board, inputs: Sequence[str], frames: int
) -> None:
    """Writes the page, beside and renamed; raises `GroundStationError` when it cannot."""
    used, wrong = result.corners
    times = magnification(result)
    views = [
        (
            f"{Path(inputs[view.seen.source]).name}, {view.seen.name}",
            str(len(view.seen.ids)),
            f"{rms:.3f}",
            f"{view.seen.edge_px:.1f}",
            f"{view.speed_px_s:.0f}" if view.velocity_px_s is not None else "—",
            f"{tilt:.0f}",
            f"{distance:.2f}",
        )
        for view, rms, tilt, distance in _in_order(result)
    ]
    write_page(
        path,
        _TEMPLATE,
        title="Camera calibration",
        summary=(
            f"{len(result.views)} views of {len(result.seen)} with the board, in {frames} frames: "
            f"{used} corners, {wrong} left out as wrong."
        ),
        rms=f"{result.fit.rms_px:.3f} px RMS",
        size=f"{result.size_px[0]}x{result.size_px[1]} px",
        board=f"{board.name}, {board.square_mm:g} mm",
        numbers=results.numbers(result),
        readout=results.readout_words(result),
        regions=results.region_rows(result),
        notes=result.notes,
        figures=[
            themed_figure(
                "Where corners were seen",
                "The corners of the board in the picture; the four corners of the picture framed",
                lambda theme: coverage(result, theme),
            ),
            themed_figure(
                f"Residuals, {times:g} times as long",
                "Arrows from where the lens puts each corner to where it was seen",
                lambda theme: residuals(result, theme),
            ),
            themed_figure(
                "Each view",
                "The RMS of each view's residuals, and the median",
                lambda theme: per_view(result, theme),
            ),
        ],
        views=views,
    )
