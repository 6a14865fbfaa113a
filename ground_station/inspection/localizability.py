"""Before a flight: how well a pose is fixed in a map, by place and by where the camera looks.

After the maps of expected pose uncertainty in planning in belief space (Prentice and Roy, IJRR
2009): the information that the landmarks in view would give, for a grid of places and headings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import MapError
from ground_station.inspection.prediction import NEEDED, Prediction, Predictor
from ground_station.map.floorplan import FloorPlan, load_floorplan
from ground_station.map.store import Map

MOST_CELLS = 600
"""Cells are as small as one, two or five times a power of ten that gives no more."""
HEADINGS = 8
_ALLOWED_HEADINGS = (1, 36)
_MOST_ASKED = 20_000

_BULK = (1.0, 99.0)
"""Percentiles of the landmarks that bound the mapped region: a few stray far off."""
_FREE = 205
"""Pixels brighter than this are free space (map_server's free_thresh); walls and what lies
outside of the building are not."""
_NEIGHBOURS = 5
_NARROWEST = 0.02
"""Of its length a region is taken as at least so wide where cells are counted."""


@dataclass(frozen=True)
class LocalizabilityMap:
    """Predictions for places (N, 3) on a grid and headings (H,).

    `cell` (N, 2) are a place's column and row in the grid of `shape` (columns, rows), whose cell
    (0, 0) has its lower left corner at `origin`; `heading_deg` is counter-clockwise from x,
    `pitch_deg` upwards, as most keyframes had it.
    """

    place: F64
    cell: I64
    shape: tuple[int, int]
    origin: tuple[float, float]
    cell_m: float
    heading_deg: F64
    pitch_deg: float
    prediction: Prediction

    def summary(self) -> dict[str, Any]:
        """What `info` says of it."""
        p = self.prediction
        lost = p.lost
        known = p.sigma_m[~lost]
        return {
            "places": len(self.place),
            "cell_m": self.cell_m,
            "headings": len(self.heading_deg),
            "needed_landmarks": NEEDED,
            "share_lost": round(float(lost.mean()), 3) if lost.size else 1.0,
            "places_lost_in_every_heading": round(float(lost.all(axis=1).mean()), 3),
            "places_lost_in_some_heading": round(float(lost.any(axis=1).mean()), 3),
            "median_sigma_m": round(float(np.median(known)), 4) if known.size else None,
        }


def localizability(
    map_: Map,
    plan: FloorPlan | None = None,
    *,
    cell_m: float | None = None,
    height_m: float | None = None,
    headings: int = HEADINGS,
) -> LocalizabilityMap:
    """Predicts for the mapped region of a map whose z is up (see `levelling.levelled`).

    The region is the box around 98 % of the landmarks and all keyframes, of which a floor plan
    leaves what has free space. The camera is as high as the keyframes near, or at `height_m`, and
    pitched as the median keyframe. Raises `MapError` for what is out of range.
    """
    if not _ALLOWED_HEADINGS[0] <= headings <= _ALLOWED_HEADINGS[1]:
        least, most = _ALLOWED_HEADINGS
        raise MapError(f"--headings is {headings}; allowed: {least} to {most}")
    if height_m is not None and not math.isfinite(height_m):
        raise MapError(f"--height-m is {height_m}; it must be a finite number")
    if not len(map_.landmarks) or not len(map_.keyframes):
        raise MapError(f"{map_.folder}: the map has no landmarks or no keyframes")
    low, high = _region(map_)
    for side in _sides(high - low, cell_m):
        origin, shape, cell = _grid(low, high, side, plan)
        if len(cell) <= MOST_CELLS:
            break
    centre = origin + side * (cell + 0.5)
    wTc = map_.keyframes.wTc
    if height_m is None:
        count = min(_NEIGHBOURS, len(wTc))
        _, near = cKDTree(wTc[:, :2, 3]).query(centre, k=count)
        height = np.median(wTc[near.reshape(len(centre), count), 2, 3], axis=1)
    else:
        height = np.full(len(centre), height_m)
    pitch = float(np.median(np.arcsin(np.clip(wTc[:, 2, 2], -1, 1))))
    heading = 2 * np.pi * np.arange(headings) / headings
    place = np.column_stack([centre, height])
    return LocalizabilityMap(
        place=place,
        cell=cell,
        shape=shape,
        origin=(float(origin[0]), float(origin[1])),
        cell_m=side,
        heading_deg=np.degrees(heading),
        pitch_deg=math.degrees(pitch),
        prediction=Predictor(map_).places(place, _looking(heading, pitch)),
    )


def _region(map_: Map) -> tuple[F64, F64]:
    bulk = np.percentile(map_.landmarks.position_m[:, :2], _BULK, axis=0)
    flown = map_.keyframes.wTc[:, :2, 3]
    return np.minimum(bulk[0], flown.min(axis=0)), np.maximum(bulk[1], flown.max(axis=0))


def _sides(size: F64, asked: float | None) -> list[float]:
    """The cell's side as asked, or round ones from too small to surely large enough."""
    longest = max(float(size.max()), 1e-9)
    area = float(np.prod(np.maximum(size, _NARROWEST * longest)))
    if asked is not None:
        least = math.sqrt(area / _MOST_ASKED)
        if not (math.isfinite(asked) and asked >= least and asked > 0):
            raise MapError(
                f"--cell-m is {asked}; allowed: {least:.3g} or more "
                f"({_MOST_ASKED} cells at most in this map)"
            )
        return [asked]
    power = 10.0 ** math.floor(math.log10(math.sqrt(area / MOST_CELLS)))
    return [step * power for step in (1, 2, 5, 10, 20, 50)]


def _grid(
    low: F64, high: F64, side: float, plan: FloorPlan | None
) -> tuple[F64, tuple[int, int], I64]:
    """Its lower left corner, columns and rows, and the cells (N, 2) with free space."""
    columns, rows = (max(1, math.ceil(length / side - 1e-9)) for length in high - low)
    # The grid lies about the region's middle.
    origin = 0.5 * (low + high) - 0.5 * side * np.array([columns, rows])
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    if plan is not None:
        keep = _has_free_space(plan, origin + side * (cell + 0.5), side)
        if keep.any():  # else it is another place's plan
            cell = cell[keep]
    return origin, (columns, rows), cell


def _has_free_space(plan: FloorPlan, centre: F64, side: float) -> Bools:
    """Whether any of a raster of points in each cell (N, 2) is free in the plan; (N,)."""
    steps = (np.arange(8) + 0.5) / 8 - 0.5
    raster = side * np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    x0, y0, yaw = plan.origin
    offset = centre[:, None] + raster - [x0, y0]
    c, s = math.cos(yaw), math.sin(yaw)
    u = np.floor((c * offset[..., 0] + s * offset[..., 1]) / plan.resolution_m)
    v = np.floor((-s * offset[..., 0] + c * offset[..., 1]) / plan.resolution_m)
    height, width = plan.image.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    column = np.where(inside, u, 0).astype(np.intp)
    row = np.where(inside, height - 1 - v, 0).astype(np.intp)
    return np.asarray((inside & (plan.image[row, column] > _FREE)).any(axis=1))


def _looking(heading_rad: F64, pitch_rad: float) -> F64:
    """wRc (H, 3, 3) of upright cameras that look along headings (H,)."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    zero = np.zeros_like(c)
    forward = np.stack([cp * c, cp * s, zero + sp], axis=1)
    right = np.stack([s, -c, zero], axis=1)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def plan_of(map_: Map) -> FloorPlan | None:
    """The floor plan in a registered map's folder, None without; raises `InputError`."""
    if map_.folder is None or not map_.info.registered:
        return None
    path = map_.folder / "floorplan.yaml"
    return load_floorplan(path) if path.is_file() else None
