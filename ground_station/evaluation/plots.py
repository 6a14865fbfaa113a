"""Pictures of an evaluation: the path over the floor plan, errors and latency over time.

In a light and a dark theme; lines differ in style as well as in colour.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from ground_station.arrays import F64
from ground_station.evaluation.ate import Evaluation
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import FloorPlan
from ground_station.presentation.theme import LIGHT, Theme, figure_of, legend, sheet, themed

GAP_S = 1.0
"""A pause longer than this breaks a line: nothing was estimated there."""


def trajectory_plot(
    truth: Trajectory | None,
    estimate: Trajectory | None,
    floorplan: FloorPlan | None = None,
    theme: Theme = LIGHT,
) -> Figure:
    """The path seen from above, x to the right and y up, metres."""
    figure, (axes,) = figure_of(1, (8.0, 5.6), theme)
    if floorplan is not None:
        show_floorplan(axes, floorplan, theme)
    if truth is not None and len(truth):
        x, y = broken_path(truth)
        axes.plot(x, y, color=theme.truth, linewidth=2.6, alpha=0.55, label="true path")
    if estimate is not None and len(estimate):
        x, y = broken_path(estimate)
        axes.plot(x, y, color=theme.estimate, linewidth=1.1, label="estimated path")
        axes.plot(
            *estimate.position_m[0, :2], "o", color=theme.estimate, markersize=6, label="first pose"
        )
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    if axes.get_legend_handles_labels()[1]:  # above the plan, not over it
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=3,
            frameon=False,
            labelcolor=theme.ink,
            fontsize=9,
        )
    return figure


def error_plot(
    time_s: npt.ArrayLike,
    position_m: npt.ArrayLike,
    rotation_deg: npt.ArrayLike,
    *,
    position_limit_m: float | None = None,
    rotation_limit_deg: float | None = None,
    theme: Theme = LIGHT,
) -> Figure:
    """Position error (cm) over rotation error (°), both over time (s); limits are RMSE bounds."""
    figure, (upper, lower) = figure_of(2, (8.0, 4.4), theme)
    limit_cm = None if position_limit_m is None else position_limit_m * 100
    rows = (
        (upper, np.asarray(position_m) * 100, limit_cm, "position error, cm", theme.estimate),
        (lower, np.asarray(rotation_deg), rotation_limit_deg, "rotation error, °", theme.second),
    )
    for axes, values, limit, label, colour in rows:
        axes.plot(*broken(time_s, values), color=colour, linewidth=1.1)
        axes.set_ylabel(label)
        if limit is not None:
            axes.axhline(
                limit, color=theme.limit, linestyle="--", lw=1.2, label="bound of the RMSE"
            )
            legend(axes, theme)
        axes.set_ylim(0, 1.3 * max(float(np.nanmax(values, initial=0.0)), limit or 0.0, 1e-3))
    lower.set_xlabel("time, s")
    return figure


def latency_plot(
    time_s: npt.ArrayLike,
    latency_ms: npt.ArrayLike,
    *,
    median_ms: float | None = None,
    p99_ms: float | None = None,
    theme: Theme = LIGHT,
) -> Figure:
    """Capture-to-pose latency of each frame (ms) over time (s)."""
    figure, (axes,) = figure_of(1, (8.0, 3.0), theme)
    axes.plot(time_s, latency_ms, ".", color=theme.estimate, markersize=4)
    axes.set_xlabel("time, s")
    axes.set_ylabel("latency, ms")
    for value, name, style in ((median_ms, "median", "-"), (p99_ms, "99th percentile", "--")):
        if value is not None:
            label = f"{name}, {value:.0f} ms"
            axes.axhline(value, color=theme.limit, linestyle=style, linewidth=1.2, label=label)
    axes.set_ylim(0, 1.5 * max(float(np.nanmax(np.asarray(latency_ms), initial=1.0)), p99_ms or 0))
    legend(axes, theme)
    return figure


def evaluation(result: Evaluation, align: str = "none") -> Figure:
    """Path, position error and rotation error of one alignment on one sheet."""
    errors = result.errors[align]
    figure = sheet((8.0, 9.6), LIGHT)
    path, upper, lower = figure.subplots(3, 1, height_ratios=[3, 1, 1])
    aligned = _aligned(result.estimate, errors.alignment)
    seconds = (result.estimate.time_ns - result.estimate.time_ns[0]) / 1e9
    path.plot(
        *broken_path(result.truth), color=LIGHT.truth, linewidth=2.6, alpha=0.55, label="truth"
    )
    path.plot(
        *broken_path(aligned),
        color=LIGHT.estimate,
        linewidth=1.1,
        label=f"estimate, aligned: {align}",
    )
    path.set_aspect("equal", adjustable="datalim")
    path.set_xlabel("x, m")
    path.set_ylabel("y, m")
    upper.plot(*broken(seconds, errors.position_m * 100), color=LIGHT.estimate, lw=1.1)
    upper.set_ylabel("position, cm")
    lower.plot(*broken(seconds, errors.rotation_deg), color=LIGHT.second, lw=1.1)
    lower.set_ylabel("rotation, °")
    lower.set_xlabel("time, s")
    for axes in (path, upper, lower):
        themed(axes, LIGHT)
    upper.set_ylim(bottom=0)
    lower.set_ylim(bottom=0)
    legend(path, LIGHT)
    return figure


def show_floorplan(axes: Axes, plan: FloorPlan, theme: Theme) -> None:
    width_m, height_m = plan.size_m
    x, y, yaw = plan.origin
    to_world = Affine2D().rotate(yaw).translate(x, y)
    # Walls in a soft tone of the ink, free space in the paper's colour: the path stays in front.
    ink = np.array([int(theme.ink[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.uint8)
    rgba: Any = np.empty((*plan.image.shape, 4), dtype=np.uint8)
    rgba[..., :3] = ink
    rgba[..., 3] = (255 - plan.image) // 2
    axes.imshow(
        rgba,
        extent=(0, width_m, 0, height_m),
        origin="upper",
        transform=to_world + axes.transData,
        interpolation="antialiased",
        zorder=0,
    )
    corners = to_world.transform(
        np.array([[0, 0], [width_m, 0], [width_m, height_m], [0, height_m]])
    )
    margin = 0.02 * max(width_m, height_m)
    axes.set_xlim(corners[:, 0].min() - margin, corners[:, 0].max() + margin)
    axes.set_ylim(corners[:, 1].min() - margin, corners[:, 1].max() + margin)


def _aligned(trajectory: Trajectory, alignment: Alignment) -> Trajectory:
    return Trajectory(
        trajectory.time_ns, alignment.apply(trajectory.position_m), trajectory.quaternion_xyzw
    )


def broken(time_s: npt.ArrayLike, *rows: npt.ArrayLike) -> list[F64]:
    """Times and rows of values (N,), each with a NaN in every pause, which the line leaves out."""
    gaps = np.flatnonzero(np.diff(np.asarray(time_s, np.float64)) > GAP_S) + 1
    return [np.insert(np.asarray(row, np.float64), gaps, np.nan) for row in (time_s, *rows)]


def broken_path(trajectory: Trajectory) -> list[F64]:
    """x and y with a NaN in every pause."""
    return broken(trajectory.time_ns / 1e9, *trajectory.position_m[:, :2].T)[1:]
