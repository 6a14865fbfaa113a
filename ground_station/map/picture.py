"""A map seen from above, as a picture: its landmarks, its way, and where images are missing."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ground_station.arrays import F64
from ground_station.map.floorplan import FloorPlan
from ground_station.map.levelling import levelled
from ground_station.map.store import Map
from ground_station.presentation.theme import Theme, sheet, themed

_LONGEST_IN, _LEAST_IN = 8.0, 3.0
_LABELS_IN = 1.2
_MOST_POINTS = 20_000
_MARGIN = 0.05
_VIEW = 0.03
"""Of the picture's longer side: the line by which a camera shows where it looks."""


def from_above(
    map_: Map,
    missing: Collection[str],
    title: str,
    theme: Theme,
    plan: FloorPlan | None = None,
) -> Figure:
    """Landmarks, and cameras in the order of their names, joined where no image is `missing`.

    `missing` are names of images without a place. Where such are between two cameras, these are
    joined by a dashed line with their number. Of an unregistered map, up is where its cameras have
    it on average, and lengths are its own. A floor `plan` that is not turned lies below all, and
    what it shows is shown.
    """
    upright = levelled(map_)
    position, place = upright.landmarks.position_m, upright.keyframes.wTc[:, :3, 3]
    low, high = _bounds(position, place) if plan is None else _corners(plan)
    sides = (high - low) * _LONGEST_IN / max(float((high - low).max()), 1e-9)
    width, height = (max(float(side), _LEAST_IN) for side in sides)
    figure = sheet((width + _LABELS_IN, height + _LABELS_IN), theme)
    axes: Axes = figure.subplots()
    themed(axes, theme, 8)
    some = slice(None, None, max(1, -(-len(position) // _MOST_POINTS)))
    axes.plot(
        *position[some, :2].T, ".", color=theme.truth, alpha=0.5, ms=3.0, mew=0,
        label=f"{len(position)} landmarks", zorder=1,
    )  # fmt: skip
    _draw_way(axes, upright, missing, theme)
    looks = upright.keyframes.wTc[:, :2, 2] * _VIEW * float((high - low).max())
    lines = np.stack([place[:, :2], place[:, :2] + looks], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=theme.estimate, linewidths=0.8))
    if plan is not None:
        extent = (low[0], high[0], low[1], high[1])
        axes.imshow(
            plan.image, cmap="gray", vmin=0, vmax=255, extent=extent, alpha=0.35,
            interpolation="nearest", zorder=0,
        )  # fmt: skip
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    unit = "m" if map_.info.units == "m" else "the map's own lengths"
    axes.set_xlabel(f"from above, {unit}", fontsize=8)
    axes.set_title(title, color=theme.ink, fontsize=9, loc="left", wrap=True)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, frameon=False,
        labelcolor=theme.ink, fontsize=8, markerscale=2.0,
    )  # fmt: skip
    return figure


def _bounds(position: F64, place: F64) -> tuple[F64, F64]:
    """The corners of what is shown: all cameras, and the landmarks but for the farthest ones."""
    low, high = place[:, :2].min(axis=0), place[:, :2].max(axis=0)
    if len(position):
        near, far = np.percentile(position[:, :2], (2, 98), axis=0)
        low, high = np.minimum(low, near), np.maximum(high, far)
    margin = _MARGIN * float((high - low).max())
    return low - margin, high + margin


def _corners(plan: FloorPlan) -> tuple[F64, F64]:
    low = np.array(plan.origin[:2])
    return low, low + np.array(plan.size_m)


def _draw_way(axes: Axes, map_: Map, missing: Collection[str], theme: Theme) -> None:
    """The cameras in the order of their names, and the gaps between them."""
    names = map_.keyframes.names
    order = sorted(range(len(names)), key=names.__getitem__)
    place = map_.keyframes.wTc[order, :2, 3]
    every = sorted([*names, *missing])
    rank = {name: k for k, name in enumerate(every)}
    ranks = np.array([rank[names[k]] for k in order])
    gaps = np.diff(ranks) - 1
    steps = np.stack([place[:-1], place[1:]], axis=1)
    axes.plot(*place.T, "o", color=theme.estimate, ms=3.0, label=f"{len(names)} cameras", zorder=3)
    whole = LineCollection(list(steps[gaps == 0]), colors=theme.estimate, linewidths=1.2)
    axes.add_collection(whole)
    if missing:
        label = f"{len(missing)} images without a place"
        axes.plot([], [], "--", color=theme.second, lw=1.6, label=label)
    for (start, end), count in zip(steps[gaps > 0], gaps[gaps > 0], strict=True):
        axes.plot(*np.stack([start, end]).T, "--", color=theme.second, lw=1.6, zorder=4)
        axes.annotate(
            str(count), tuple((start + end) / 2), color=theme.second, fontsize=9, zorder=5,
            xytext=(3, 3), textcoords="offset points",
        )  # fmt: skip
    # What is missing at the ends has no line to be on.
    ends = (("start", 0, ranks[0], "before"), ("end", -1, len(every) - 1 - ranks[-1], "after"))
    for text, k, count, where in ends:
        axes.annotate(
            f"{text} ({count} missing {where} it)" if count else text, tuple(place[k]),
            color=theme.second if count else theme.ink, fontsize=8, zorder=5,
            xytext=(4, -9), textcoords="offset points",
        )  # fmt: skip
