"""Pictures of runs: paths coloured by how far they are off, errors over time, distributions.

Colours are evaluation's (Okabe and Ito); what is coloured by a number has `cividis`, which people
of every colour vision read alike. Lines differ in style, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ground_station.arrays import F64
from ground_station.evaluation import plots
from ground_station.geometry.trajectory import Trajectory
from ground_station.localization.estimate import State
from ground_station.map.floorplan import FloorPlan
from ground_station.presentation.theme import ABOVE, LIGHT, Theme, figure_of, legend

WIDTH_IN = 6.6
"""Narrow, so that what is written in a picture can be read on a narrow screen."""
_SMALL = 8.5
_LEAST = {"cm": 0.1, "°": 0.01, "ms": 1.0}
_STATES = {
    State.TRACKING.value: "#009e73",
    State.DEGRADED.value: "#e69f00",
    State.LOST.value: "#d55e00",
    State.INITIALIZING.value: "#8c8c8c",
}


@dataclass(frozen=True)
class Series:
    """Values over time of one run: `time_s` and `values`, (N,) each; `style` 0 is A's, 1 is B's."""

    label: str
    time_s: F64
    values: F64
    style: int = 0


@dataclass(frozen=True)
class Strip:
    """The states of a run over time: `time_s` (N,), `states` N names."""

    label: str
    time_s: F64
    states: Sequence[str]


def path(
    points_m: F64,
    off_m: F64,
    *,
    under: Sequence[tuple[str, Trajectory]] = (),
    lost_m: F64 | None = None,
    first_m: F64 | None = None,
    floorplan: FloorPlan | None = None,
    label: str = "off, cm",
    theme: Theme = LIGHT,
) -> Figure:
    """A path from above, each of its poses (N, 3) coloured by how far it is off (N,).

    `under` are other paths, as lines; `lost_m` (K, 3) poses that this one is without; `first_m`
    (3,) where two runs part. Where nothing is off a colour scale would only mislead: it ends at a
    millimetre at least.
    """
    figure, (axes,) = figure_of((WIDTH_IN, 4.9), theme)
    if floorplan is not None:
        plots.show_floorplan(axes, floorplan, theme)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    for k, (name, trajectory) in enumerate(under):
        x, y = plots.broken_path(trajectory)
        style = "-" if k == 0 else "--"
        axes.plot(x, y, color=theme.truth, lw=3.2 - 2 * k, alpha=0.4, ls=style, label=name)
    if lost_m is not None and len(lost_m):
        axes.plot(*lost_m[:, :2].T, "x", color=theme.second, ms=5, mew=1.2, label="without a pose")
    finite = np.isfinite(off_m)
    if finite.any():
        order = np.argsort(off_m[finite])  # the worst on top
        xy, cm = points_m[finite][order, :2], 100 * off_m[finite][order]
        # Dark on white paper, light on black: far off stands out on both.
        scale = "cividis_r" if theme is LIGHT else "cividis"
        top = max(0.1, float(cm[-1]))
        drawn = axes.scatter(
            xy[:, 0], xy[:, 1], s=9, c=cm, cmap=scale, vmin=0.0, vmax=top, zorder=3
        )
        bar = figure.colorbar(drawn, ax=axes, fraction=0.045, pad=0.02)
        bar.set_label(label, color=theme.ink, fontsize=_SMALL)
        bar.ax.tick_params(colors=theme.ink, labelsize=_SMALL)
        bar.outline.set_visible(False)
    if first_m is not None and np.isfinite(first_m).all():
        axes.plot(*first_m[:2], "o", mfc="none", mec=theme.second, ms=13, mew=2, zorder=4,
                  label="first difference")  # fmt: skip
    _zoom(axes, [points_m, *(t.position_m for _, t in under)])
    legend(axes, theme, **ABOVE, fontsize=_SMALL)
    return figure


def _zoom(axes: Axes, paths_m: Sequence[F64]) -> None:
    """To the paths with some of the plan around them: in a large hall a short one is a speck."""
    every = np.vstack([path[:, :2] for path in paths_m])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        return
    low, high = every.min(axis=0), every.max(axis=0)
    margin = max(1.0, 0.15 * float((high - low).max()))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)


def over_time(
    panels: Sequence[tuple[str, Sequence[Series], float | None]],
    strips: Sequence[Strip],
    outages_s: Sequence[tuple[float, float]] = (),
    theme: Theme = LIGHT,
) -> Figure:
    """Panels over one another, each a label, its series and a bound; the states below; outages
    shaded. Times are seconds from the flight's first frame."""
    heights = [1.7] * len(panels) + [0.3 + 0.22 * len(strips)]
    figure, grid = figure_of(
        (WIDTH_IN, sum(heights) + 0.7), theme, len(heights), label_size=_SMALL, sharex=True,
        height_ratios=heights,
    )  # fmt: skip
    for axes, (label, series, bound) in zip(grid, panels, strict=False):
        # Of what is nothing at all the axis shows a usual span, not the rounding.
        top = max(_LEAST.get(label.rpartition(", ")[2], 1e-6), bound or 0.0)
        for one in series:
            colour, line = _style(one.style, theme)
            t, v = plots.broken(one.time_s, one.values)
            axes.plot(t, v, color=colour, ls=line, lw=1.2, label=one.label)
            top = max(top, float(np.nanmax(one.values, initial=0.0)))
        if bound is not None:
            axes.axhline(bound, color=theme.limit, ls=":", lw=1.4, label="bound")
        axes.set_ylim(0, 1.15 * top)
        axes.set_ylabel(label, fontsize=_SMALL)
        _shade(axes, outages_s, theme)
        if len(series) > 1 or bound is not None or outages_s:
            legend(axes, theme, **ABOVE, fontsize=_SMALL)
    _draw_strips(grid[-1], strips, theme)
    _shade(grid[-1], outages_s, theme)
    grid[-1].set_xlabel("time, s", fontsize=_SMALL)
    return figure


def distributions(
    panels: Sequence[tuple[str, Sequence[tuple[str, F64]]]], theme: Theme = LIGHT
) -> Figure:
    """Cumulative distributions side by side: each panel a label and (name, values) of A and B."""
    figure, grid = figure_of(
        (WIDTH_IN, 2.9), theme, columns=len(panels), label_size=_SMALL, sharey=True
    )
    for axes, (label, sets) in zip(grid, panels, strict=True):
        for k, (name, values) in enumerate(sets):
            known = np.sort(values[np.isfinite(values)])
            if not len(known):
                continue
            colour, line = _style(k, theme)
            share = np.arange(1, len(known) + 1) / len(known)
            axes.step(known, share, where="post", color=colour, ls=line, lw=1.4, label=name)
        axes.set_xlim(left=0)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel(label, fontsize=_SMALL)
        legend(axes, theme, **ABOVE, fontsize=_SMALL)
    grid[0].set_ylabel("share of frames", fontsize=_SMALL)
    return figure


def _draw_strips(axes: Axes, strips: Sequence[Strip], theme: Theme) -> None:
    axes.grid(False)
    seen: set[str] = set()
    for row, strip in enumerate(strips):
        for name, begin_s, end_s in _stretches(strip):
            axes.barh(-row, end_s - begin_s, left=begin_s, height=0.72, color=_STATES[name])
            seen.add(name)
    axes.set_yticks([-row for row in range(len(strips))], [strip.label for strip in strips])
    axes.tick_params(axis="y", length=0, labelsize=_SMALL)
    axes.spines["left"].set_visible(False)
    handles = [Patch(color=_STATES[name], label=name) for name in _STATES if name in seen]
    legend(axes, theme, **ABOVE, handles=handles, fontsize=_SMALL - 1)


def _stretches(strip: Strip) -> list[tuple[str, float, float]]:
    """Runs of the same state without a pause: name, begin, end, seconds."""
    t = strip.time_s
    if not len(t):
        return []
    step_s = float(np.median(np.diff(t))) if len(t) > 1 else 0.033
    found: list[tuple[str, float, float]] = []
    begin = 0
    for k in range(1, len(t) + 1):
        ended = k == len(t) or strip.states[k] != strip.states[k - 1]
        if ended or t[k] - t[k - 1] > max(3 * step_s, 0.2):
            found.append((strip.states[begin], float(t[begin]), float(t[k - 1]) + step_s))
            begin = k
    return found


def _style(k: int, theme: Theme) -> tuple[str, str]:
    return (theme.estimate, "-") if k == 0 else (theme.second, "--")


def _shade(axes: Axes, outages_s: Sequence[tuple[float, float]], theme: Theme) -> None:
    for number, (begin_s, end_s) in enumerate(outages_s):
        label = "out" if number == 0 else None
        axes.axvspan(begin_s, end_s, color=theme.ink, alpha=0.13, lw=0, label=label)
