"""Pictures of an evaluation: the path and errors over time, and what other pictures are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from ground_station.arrays import F64
from ground_station.evaluation.ate import Evaluation
from ground_station.geometry.trajectory import Trajectory
from ground_station.map.floorplan import FloorPlan
from ground_station.presentation.theme import LIGHT, Theme, figure_of, legend

GAP_S = 1.0
"""A pause longer than this breaks a line: nothing was estimated there."""


def evaluation(result: Evaluation, align: str = "none") -> Figure:
    """Path, position error and rotation error of one alignment on one sheet."""
    errors = result.errors[align]
    figure, (path, upper, lower) = figure_of((8.0, 9.6), LIGHT, 3, height_ratios=[3, 1, 1])
    x, y, _ = errors.alignment.apply(result.estimate.position_m).T
    seconds = (result.estimate.time_ns - result.estimate.time_ns[0]) / 1e9
    path.plot(
        *broken_path(result.truth), color=LIGHT.truth, linewidth=2.6, alpha=0.55, label="truth"
    )
    path.plot(
        *broken(seconds, x, y)[1:],
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


def broken(time_s: npt.ArrayLike, *rows: npt.ArrayLike) -> list[F64]:
    """Times and rows of values (N,), each with a NaN in every pause, which the line leaves out."""
    gaps = np.flatnonzero(np.diff(np.asarray(time_s, np.float64)) > GAP_S) + 1
    return [np.insert(np.asarray(row, np.float64), gaps, np.nan) for row in (time_s, *rows)]


def broken_path(trajectory: Trajectory) -> list[F64]:
    """x and y with a NaN in every pause."""
    return broken(trajectory.time_ns / 1e9, *trajectory.position_m[:, :2].T)[1:]
