"""Pictures of experiments: paths coloured by their error, error over time, its distribution."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from ground_station.evaluation.plots import broken, show_floorplan
from ground_station.experiments.tables import NAMES
from ground_station.map.floorplan import FloorPlan
from ground_station.presentation.theme import Theme, figure_of, legend

_MOST_PATHS = 6
_LEAST_M, _MOST_M = 0.002, 0.5
"""Ends of the error's colours, which are logarithmic: a run's errors span two powers of ten."""
_MARKS_M = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
_WIDTH_IN, _HIGHEST_IN = 8.0, 5.0
_LABELS_IN, _BAR_IN = 0.75, 0.7
"""Room for a panel's numbers and title, and for the bar of colours below all."""
_COLOURS = "cividis"
"""Even in lightness, and the same to every colour vision (Nuñez, Anderton, Renslow, 2018)."""
_STYLES = {"thesis": "--", "alone": ":", "default": "-"}
_HUES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's, readable on both papers."""


def paths(cases: Sequence[dict[str, Any]], plan: FloorPlan | None, theme: Theme) -> Figure:
    """The default's path of each case's first seed from above, its colour the position error."""
    shown = [(c["title"], s) for c in cases if (s := first_series(c, "default"))][:_MOST_PATHS]
    count = max(1, len(shown))
    columns = 2 if count in (2, 4) else min(3, count)
    rows = -(-count // columns)
    panel_m = plan.size_m if plan is not None else _extent([series for _, series in shown])
    wide = _WIDTH_IN / columns - _LABELS_IN
    tall = min(wide * panel_m[1] / panel_m[0], _HIGHEST_IN) + _LABELS_IN
    figure, axes = figure_of((_WIDTH_IN, tall * rows + _BAR_IN), theme, rows, columns, label_size=8)
    points = None
    for one, (title, series) in zip(axes, shown, strict=False):
        if plan is not None:
            show_floorplan(one, plan, theme)
        error = np.clip(series["position_m"], _LEAST_M, _MOST_M)
        points = one.scatter(
            series["x_m"], series["y_m"], c=error, s=5, cmap=_COLOURS,
            norm=LogNorm(_LEAST_M, _MOST_M),
        )  # fmt: skip
        one.set_aspect("equal")
        one.set_title(title, color=theme.ink, fontsize=9)
        one.set_xlabel("x, m")
        one.set_ylabel("y, m")
    for one in axes[len(shown) :]:
        one.set_visible(False)
    if points is not None:
        bar = figure.colorbar(
            points, ax=axes, location="bottom", shrink=0.6, aspect=40, pad=0.03,
            label="position error, m", ticks=_MARKS_M, format="%g",
        )  # fmt: skip
        bar.ax.minorticks_off()
        bar.ax.tick_params(colors=theme.ink, labelsize=8)
        bar.ax.xaxis.label.set_color(theme.ink)
    return figure


def over_time(cases: Sequence[dict[str, Any]], theme: Theme) -> Figure:
    """Position error of each case's first seed over time: thesis dashed, alone dotted."""
    figure, (axes,) = figure_of((8.0, 3.2), theme, label_size=8)
    for case, preset, look in _lines(cases):
        if series := first_series(case, preset):
            t, e = broken(series["time_s"], 100 * np.asarray(series["position_m"]))
            axes.plot(t, e, linewidth=1.0, **look)
    _logarithmic(axes, "y")
    axes.set_xlabel("time, s")
    axes.set_ylabel("position error, cm")
    legend(axes, theme, loc="best", fontsize=8)
    return figure


def distribution(cases: Sequence[dict[str, Any]], theme: Theme) -> Figure:
    """The share of a flight's frames within an error, over all seeds: thesis dashed, alone dotted.

    Frames that were not localized count: a line that ends below 1 has lost the rest.
    """
    figure, (axes,) = figure_of((8.0, 3.4), theme, label_size=8)
    for case, preset, look in _lines(cases):
        runs = [r for r in case["presets"].get(preset, {}).get("runs", []) if "failed" not in r]
        errors = np.sort([e for run in runs for e in run["series"].get("position_m", [])])
        if len(errors):
            share = np.arange(1, len(errors) + 1) / sum(run["frames"] for run in runs)
            errors_cm = 100 * np.maximum(errors, 1e-4)
            axes.step(errors_cm, share, where="post", linewidth=1.2, **look)
    _logarithmic(axes, "x")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("position error, cm")
    axes.set_ylabel("share of frames")
    legend(axes, theme, loc="best", fontsize=8)
    return figure


def sweep(cases: Sequence[dict[str, Any]], level: str, theme: Theme) -> Figure:
    """Position error and share localized over what the cases vary, mean and spread."""
    figure, (upper, lower) = figure_of((8.0, 4.6), theme, 2, label_size=8, sharex=True)
    places = np.arange(len(cases))
    for (preset, style), hue in zip(
        _STYLES.items(), (theme.second, theme.limit, theme.estimate), strict=True
    ):
        found = [case["presets"].get(preset, {}) for case in cases]
        mean = [_value(row.get("position_m"), "mean") for row in found]
        std = [_value(row.get("position_m"), "std") for row in found]
        upper.errorbar(
            places, 100 * np.asarray(mean), 100 * np.asarray(std), fmt="o" + style, color=hue,
            capsize=3, linewidth=1.2, markersize=4, label=NAMES[preset],
        )  # fmt: skip
        share = [np.nan if row.get("localized") is None else row["localized"] for row in found]
        lower.plot(places, 100 * np.asarray(share), "o" + style, color=hue, markersize=4, lw=1.2)
    _logarithmic(upper, "y")
    upper.set_ylabel("position error, cm")
    lower.set_ylabel("localized, %")
    lower.set_ylim(0, 104)
    lower.set_xticks(places, [str(case["title"]) for case in cases])
    lower.set_xlabel(level)
    legend(upper, theme, loc="best", fontsize=8)
    return figure


def _extent(paths: Sequence[dict[str, list[float]]]) -> tuple[float, float]:
    """Width and height, m, that the longest of the paths take; of a square without any."""
    sizes = [(np.ptp(path["x_m"]), np.ptp(path["y_m"])) for path in paths]
    width, height = np.max(sizes, axis=0) if sizes else (1.0, 1.0)
    return max(float(width), 1e-3), max(float(height), 1e-3)


def first_series(case: dict[str, Any], preset: str) -> dict[str, list[float]]:
    """Frame by frame, of the first seed whose run localized any; empty where none did."""
    for run in case["presets"].get(preset, {}).get("runs", []):
        series: dict[str, list[float]] = run.get("series") or {}
        if series.get("time_s"):
            return series
    return {}


def _logarithmic(axes: Axes, name: Literal["x", "y"]) -> None:
    """A logarithmic axis with plain numbers: nobody reads 6 x 10^0 centimetres."""
    axes.set(**{f"{name}scale": "log"})
    axis = axes.yaxis if name == "y" else axes.xaxis
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_formatter(plain)
    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_minor_formatter(plain)
    axis.set_tick_params(which="minor", labelsize=8, colors=axes.xaxis.label.get_color())


def _value(found: dict[str, float] | None, key: str) -> float:
    return float("nan") if found is None else found[key]


def _lines(cases: Sequence[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], str, dict[str, Any]]]:
    """Each case and preset, and its line's colour, style and, of the default, label."""
    for hue, case in zip(itertools.cycle(_HUES), cases, strict=False):
        for preset, style in _STYLES.items():
            label = str(case["title"]) if preset == "default" else None
            yield case, preset, {"color": hue, "linestyle": style, "label": label}
