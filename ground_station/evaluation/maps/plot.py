"""Sizes against accuracy as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ground_station.evaluation.plots import LIGHT, dressed

_SIGNS = "osD^v*XP"


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
            axes.plot(x, y, marker=_SIGNS[k % len(_SIGNS)], lw=1.0, label=f"{each} bytes{said}")
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
        axes.set_ylabel("ATE, cm")
        axes.set_ylim(bottom=0)
        kind = "simulated flight" if about["simulated"] else "flight"
        axes.set_title(f"{kind} '{name}'", color=LIGHT.ink, fontsize=10, loc="left")
        axes.legend(frameon=False, labelcolor=LIGHT.ink, fontsize=8, ncols=2)
    grid[-1].set_xlabel("size of the map, kB; numbers: landmarks")
    return figure
