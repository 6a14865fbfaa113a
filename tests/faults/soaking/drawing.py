"""The picture of a long run: what each value did, its slope, and the slope that would matter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ground_station.presentation.theme import LIGHT, figure_of
from soaking.judging import slope_text
from soaking.measures import CLOCK, DESCRIPTORS, KINDS, LATENCY, MEMORY, Array, Measure
from soaking.trend import Trend, trend

# Okabe and Ito's, as in the product's own pictures; each comes with a line style of its own.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1d2329")
_STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 1)))
_LABELS = {
    MEMORY: "memory, MB\nfrom where it settled",
    DESCRIPTORS: "open files\nfrom where it settled",
    LATENCY: "latency, ms",
    CLOCK: "clock, ms\nfrom where it settled",
}
_SHIFTED = (MEMORY, DESCRIPTORS, CLOCK)
"""Values that differ much from one to the next: each is drawn from its own settled level on."""


def picture(measures: Sequence[Measure], settled_s: float, title: str) -> Figure:
    """One panel for each kind of measure, over the hours.

    Thin: the samples. Thick: the trend from `settled_s` on, where the grey ends. From there a wedge
    opens with the slope that matters: a trend that leaves it is a leak, and one whose interval (in
    the legend) reaches beyond the bound is not told.
    """
    kinds = [kind for kind in KINDS if any(m.kind == kind and m.points for m in measures)]
    chosen = [[m for m in measures if m.kind == kind and m.points] for kind in kinds]
    lines = sum(len(some) for some in chosen)
    size = (9.0, 1.0 + 2.2 * max(1, len(kinds)) + 0.17 * lines)
    figure, panels = figure_of(size, LIGHT, max(1, len(kinds)), sharex=True)
    for axes, kind, some in zip(panels, kinds, chosen, strict=False):
        _panel(axes, kind, some, settled_s)
    panels[-1].set_xlabel("hours from the start")
    figure.suptitle(title, fontsize=11, color=LIGHT.ink, x=0.01, ha="left")
    return figure


def _panel(axes: Axes, kind: str, measures: Sequence[Measure], settled_s: float) -> None:
    axes.set_ylabel(_LABELS[kind])
    axes.axvspan(0.0, settled_s / 3600.0, color=LIGHT.grid, alpha=0.6, linewidth=0)
    judged = any(measure.matters is not None for measure in measures)
    wedges: set[tuple[float, float]] = set()
    shown: list[float] = []
    for number, measure in enumerate(measures):
        colour, style = _COLOURS[number % len(_COLOURS)], _STYLES[number % len(_STYLES)]
        points = np.array(measure.points, np.float64).reshape(-1, 2)
        settled = measure.settled(settled_s)
        found = trend(settled, measure.step)
        base = found.level if kind in _SHIFTED and math.isfinite(found.level) else 0.0
        hours = points[:, 0] / 3600.0
        axes.plot(hours, points[:, 1] - base, color=colour, linewidth=0.8, alpha=0.6)
        trend_h, trend_y = np.empty(0), np.empty(0)
        if math.isfinite(found.slope):
            trend_h = np.array([0.0, found.span_h])
            trend_y = found.level - base + found.slope * trend_h
            shown += [] if judged and measure.matters is None else list(settled[:, 1] - base)
            if measure.matters is not None and (found.level - base, measure.matters) not in wedges:
                wedges.add((found.level - base, measure.matters))
                shown += _wedge(axes, measure, found, found.level - base)
        axes.plot(
            found.from_s / 3600.0 + trend_h, trend_y, color=colour, linestyle=style, linewidth=2.4,
            label=_legend_line(measure, found),
        )  # fmt: skip
    _limits(axes, shown, least=1.0 if kind == DESCRIPTORS else 1e-3)
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=1, frameon=False, fontsize=8,
        labelcolor=LIGHT.ink, handlelength=4.5, borderaxespad=0.1, labelspacing=0.2,
    )  # fmt: skip


def _legend_line(measure: Measure, found: Trend) -> str:
    text = measure.name
    if measure.kind in _SHIFTED and math.isfinite(found.level):
        text += f", at {found.level:.4g} {measure.unit}"
    text += f": {slope_text(found)} {measure.unit}/h"
    if measure.matters is None:
        return f"{text}, not judged"
    return f"{text}, bound {'±' if measure.both else ''}{measure.matters:g}"


def _wedge(axes: Axes, measure: Measure, found: Trend, level: float) -> list[float]:
    """What the slope that matters would make of a measure; the values at its end."""
    assert measure.matters is not None
    hours = found.from_s / 3600.0 + np.array([0.0, found.span_h])
    top = np.array([0.0, found.span_h]) * measure.matters
    bottom: Array = -top if measure.both else np.zeros(2)
    axes.fill_between(hours, level + bottom, level + top, color=LIGHT.limit, alpha=0.16, lw=0)
    for edge in (top, bottom) if measure.both else (top,):
        axes.plot(hours, level + edge, color=LIGHT.limit, linewidth=1.0)
    return [float(level + bottom[1]), float(level + top[1])] * 20


def _limits(axes: Axes, shown: Sequence[float], least: float) -> None:
    """So that settled samples and bounds fill the panel, and neither start nor rare spikes do."""
    if shown:
        low, high = np.quantile(shown, (0.01, 0.99))
        room = max(0.15 * (high - low), least)
        axes.set_ylim(low - room, high + room)
