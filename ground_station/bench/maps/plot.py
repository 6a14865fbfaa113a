"""What many images cost as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from ground_station.presentation.theme import LIGHT, figure_of, legend

_SIGNS = "osD^vXP"
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Okabe and Ito's, one for each sign."""


def scaling_plot(rows: Sequence[dict[str, Any]], most_gb: float) -> Figure:
    """Time (s) and peak memory (GB) over the number of images, all logarithmic.

    `rows` as `scale.measured` gives them; a line each for threads and for so many processes. A
    dashed line shows time that grows as the images do, another the memory allowed.
    """
    figure, (upper, lower) = figure_of((8.0, 7.2), LIGHT, 2, sharex=True)
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
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylabel(name)
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        legend(axes, LIGHT, loc="best", frameon=False, fontsize=8)
    lower.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))  # less than a decade
    lower.set_xticks(x, [str(size) for size in x])
    lower.xaxis.set_minor_formatter(NullFormatter())
    lower.set_xlabel("images of a simulated campus")
    return figure
