"""Sizes against accuracy as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from ground_station.presentation.dress import LIGHT, dressed

_SIGNS = "osD^vXP"
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Okabe and Ito's, one for each sign."""


def sizes_plot(rows: Sequence[dict[str, Any]], flights: dict[str, dict[str, Any]]) -> Figure:
    """Error (cm) over size (kB, logarithmic) of rows as `table.tables` takes them.

    One pair of axes a flight; maps of the same descriptors have the same sign and are joined.
    """
    figure = Figure(figsize=(8.0, 3.6 * len(flights)), layout="constrained", facecolor=LIGHT.paper)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(flights), 1, sharex=True, squeeze=False)[:, 0]
    whole, *others = rows
    forms = list(dict.fromkeys((row["method"], row["descriptor_bytes"]) for row in others))
    for axes, (name, about) in zip(grid, flights.items(), strict=True):
        dressed(axes, LIGHT)
        for k, (method, each) in enumerate(forms):
            mine = [r for r in others if (r["method"], r["descriptor_bytes"]) == (method, each)]
            x = [row["bytes"]["total"] / 1e3 for row in mine]
            y = [1e2 * row["flights"][name]["rmse_m"] for row in mine]
            said = "" if method == "coverage" else f", {method}"
            sign, colour = _SIGNS[k % len(_SIGNS)], _COLOURS[k % len(_COLOURS)]
            axes.plot(x, y, marker=sign, color=colour, lw=1.0, label=f"{each} bytes{said}")
            for a, b, row in zip(x, y, mine, strict=True):
                axes.annotate(
                    str(row["landmarks"]), (a, b), textcoords="offset points", xytext=(5, 5),
                    fontsize=8, color=LIGHT.ink,
                )  # fmt: skip
        error_cm = 1e2 * whole["flights"][name]["rmse_m"]
        axes.plot(whole["bytes"]["total"] / 1e3, error_cm, "*", ms=12, color=LIGHT.ink,
                  label="the whole map")  # fmt: skip
        axes.axhline(1.1 * error_cm, color=LIGHT.limit, linestyle="--", lw=1.2, label="10 % more")
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("ATE, cm")
        axes.set_ylim(0, 1.2 * axes.get_ylim()[1])
        kind = "simulated flight" if about["simulated"] else "flight"
        axes.set_title(f"{kind} '{name}'", color=LIGHT.ink, fontsize=10, loc="left")
        axes.legend(frameon=False, labelcolor=LIGHT.ink, fontsize=8, ncols=2, loc="lower right")
    grid[-1].set_xlabel("size of the map, kB; numbers: landmarks")
    return figure


def scaling_plot(rows: Sequence[dict[str, Any]], most_gb: float) -> Figure:
    """Time (s) and peak memory (GB) over the number of images, all logarithmic.

    `rows` as `scale.measured` gives them; a line each for threads and for so many processes. A
    dashed line shows time that grows as the images do, another the memory allowed.
    """
    figure = Figure(figsize=(8.0, 7.2), layout="constrained", facecolor=LIGHT.paper)
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for k, processes in enumerate(dict.fromkeys(row["processes"] for row in rows)):
        mine = [row for row in rows if row["processes"] == processes]
        x = [row["images"] for row in mine]
        name = f"{processes} processes" if processes else f"{mine[0]['threads']} threads"
        sign, colour = _SIGNS[k % len(_SIGNS)], _COLOURS[k % len(_COLOURS)]
        for axes, key in ((upper, "total_s"), (lower, "peak_gb")):
            y = [row[key] for row in mine]
            axes.plot(x, y, marker=sign, color=colour, lw=1.0, label=name)
        upper.plot(
            x, [row["cpu_s"] for row in mine], marker=sign, color=colour, lw=1.0, ls=":",
            label=f"{name}, CPU time",
        )  # fmt: skip
    first = min(rows, key=lambda row: row["images"])
    x = sorted({row["images"] for row in rows})
    linear = [first["total_s"] * size / first["images"] for size in x]
    upper.plot(x, linear, "--", color=LIGHT.limit, lw=1.2, label="linear")
    lower.axhline(most_gb, color=LIGHT.limit, linestyle="--", lw=1.2, label="allowed")
    for axes, name in ((upper, "time, s"), (lower, "peak memory, GB")):
        dressed(axes, LIGHT)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylabel(name)
        axes.legend(frameon=False, labelcolor=LIGHT.ink, fontsize=8)
    lower.set_xticks(x, [str(size) for size in x])
    lower.xaxis.set_minor_formatter(NullFormatter())
    lower.set_xlabel("images of a simulated campus")
    return figure
