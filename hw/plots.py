"""Plots of the budget, as PNG files: lift over the day, margin part by part, minutes by cell."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hw import output
from hw.builds import Build
from hw.buoyancy import Margin, lift_in
from hw.endurance import MODES, Wear, fly
from hw.inverse import cell_of, payload_cell, with_cell

_BLUE, _ORANGE, _GREY, _GREEN, _RED = "#2b6cb0", "#c05621", "#a0aec0", "#2f855a", "#c53030"


def draw(build: Build, margin: Margin, wear: Wear, folder: Path) -> list[Path]:
    """Draws all of them into a folder; returns the files. No window is opened."""
    import matplotlib

    matplotlib.use("Agg")
    made = []
    plots = {"lift.png": _lift(build, margin), "margin.png": _margin(build, margin),
             "endurance.png": _endurance(build, wear)}  # fmt: skip
    for name, figure in plots.items():
        path = folder / name
        output.write(path, partial(figure.savefig, dpi=110, format="png"))
        made.append(path)
    return made


def _figure(columns: int, width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(1, columns, sharey=columns > 1)
    for axis in np.atleast_1d(axes):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.3)
    return figure, axes


def _lift(build: Build, margin: Margin) -> Any:
    """Gross lift against temperature and altitude, for three purities; what it must carry."""
    figure, (left, right) = _figure(2, 10, 4.2)
    day, volume = build.conditions, build.hull.envelope.volume_m3
    day = replace(day, air_kg_m3=None, helium_kg_m3=None)
    temperatures, altitudes = np.linspace(0, 40, 21), np.linspace(0, 2500, 26)
    for purity, colour in ((99.9, _GREEN), (97.0, _BLUE), (93.0, _ORANGE)):
        of = replace(day, purity_percent=purity)
        left.plot(
            temperatures,
            [lift_in(replace(of, temperature_C=float(t)), volume) for t in temperatures],
            color=colour, label=f"helium {purity:g} %",
        )  # fmt: skip
        right.plot(
            altitudes,
            [lift_in(replace(of, altitude_m=float(h)), volume) for h in altitudes],
            color=colour,
        )
    for axis in (left, right):
        axis.axhline(margin.mass_g, color=_RED, linestyle="--", label="all that flies")
    left.set(xlabel="temperature, °C", ylabel="gross lift, g")
    right.set(xlabel="altitude, m (standard pressure, same temperature)")
    left.legend(frameon=False)
    figure.suptitle(
        f"{build.name}: lift of {volume:.4f} m³, {day.humidity_percent:g} % humidity,"
        f" {day.days:g} day after filling",
        fontsize=11,
    )
    return figure


def _margin(build: Build, margin: Margin) -> Any:
    """One bar a part, each beginning where the one before ended, from gross lift to margin."""
    figure, axis = _figure(1, 9, 0.32 * len(build.items) + 1.6)
    level = margin.gross_g
    labels = ["gross lift"]
    axis.barh(0, level, color=_BLUE)
    axis.text(level, 0, f" {level:.1f} g", va="center", fontsize=8)
    for row, item in enumerate(build.items, 1):
        axis.barh(row, -item.mass_g, left=level, color=_GREY, xerr=item.spread_g,
                  error_kw={"ecolor": "#4a5568", "capsize": 2, "lw": 1})  # fmt: skip
        axis.text(level + item.spread_g, row, f"  −{item.mass_g:.1f}", va="center", fontsize=8)
        level -= item.mass_g
        labels.append(item.name)
    last = len(build.items) + 1
    colour = _GREEN if margin.margin_g > 0 else _RED
    axis.barh(last, margin.margin_g, color=colour, xerr=margin.sigma_g,
              error_kw={"ecolor": "black", "capsize": 3})  # fmt: skip
    axis.text(max(margin.margin_g, 0) + margin.sigma_g, last,
              f"  {margin.margin_g:+.1f} ± {margin.sigma_g:.1f} g", va="center", fontsize=9,
              fontweight="bold")  # fmt: skip
    labels.append("margin")
    axis.set_yticks(range(len(labels)), labels, fontsize=8)
    axis.invert_yaxis()
    axis.axvline(0, color="black", lw=0.8)
    axis.set(xlabel="g (whiskers: one standard deviation)", title=f"{build.name}: margin")
    axis.set_xlim(min(0.0, 1.3 * level), 1.12 * margin.gross_g)
    return figure


def _endurance(build: Build, wear: Wear) -> Any:
    """Minutes against the cell's capacity, its mass and rating growing with it."""
    figure, axis = _figure(1, 7.5, 4.4)
    cell = payload_cell(build)
    capacities = np.linspace(300, 3000, 28)
    for mode, colour in zip(MODES, (_GREEN, _BLUE, _ORANGE), strict=True):
        minutes, refused = [], []
        for capacity in capacities:
            flown = fly(with_cell(build, cell_of(build, float(capacity))), mode, wear)
            minutes.append(flown.minutes)
            refused.append(flown.verdict in ("refuse", "none"))
        here, off = np.array(minutes), np.array(refused)
        axis.plot(capacities, here, color=colour, label=mode)
        axis.plot(capacities[off], here[off], "x", color=_RED, markersize=6)
    axis.plot([], [], "x", color=_RED, label="current above the rating")
    axis.axvline(cell.capacity_mAh, color=_GREY, linestyle="--", label=f"{cell.name}")
    ticks = [5, 10, 20, 30, 60, 120, 240, 480]
    axis.set_yscale("log")
    axis.set_ylim(ticks[0], 2 * ticks[-1])
    axis.set_yticks(ticks, [f"{t}" for t in ticks])
    axis.minorticks_off()
    axis.set(
        xlabel="capacity of the cell, mAh", ylabel="minutes",
        title=f"{build.name}: {wear.health_percent:g} % of the capacity left,"
        f" down to {wear.cutoff_V:g} V",
    )  # fmt: skip
    second = axis.secondary_xaxis(
        "top", functions=(lambda c: c * cell.mass_g / cell.capacity_mAh,
                          lambda m: m * cell.capacity_mAh / cell.mass_g),
    )  # fmt: skip
    second.set_xlabel("its mass, g")
    axis.legend(frameon=False, fontsize=8)
    return figure
