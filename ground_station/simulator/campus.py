"""A campus without end, as features: what an extractor would find on the walls along a long way.

Corridors on a grid, some crossings widened to halls, and a way through them that comes back to
where it was. Nothing is rendered: each image is what its pose sees of the points on walls, floors
and ceilings, with noise of pixels and of descriptors, points that are missed, and panels that
repeat. So a build of ten thousand images can be studied without ten thousand pictures; how good
features are on real walls is not what this shows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64, I64, Bools
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera

CAMERA = Camera(240, 180, 120.0, 120.0, 119.5, 89.5, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A small picture, 90 degrees wide."""

_GRID_M, _WIDTH_M, _HEIGHT_M, _HALL_M = 10.0, 3.0, 3.0, 7.0
_HALLS = 0.25
"""Share of the crossings that are halls."""
_NEW = 0.7
"""Share of the way that leads through corridors for the first time, about."""
_EYE_M, _STEP_M, _TURN_DEG = 1.6, 0.35, 7.0
"""An image is taken when the camera moved or turned so far; both count together."""
_GLANCE_DEG, _GLANCE_M = 25.0, 9.0
"""It looks so far to either side of its way, and back within so many metres."""
_FORWARD_M = 0.2
"""How far an image is from the next on average, as the camera turns, too."""
_CELL_M = 0.25
_SEEN_M = 12.0
_WALL_DENSITY, _OTHER_DENSITY = 7.0, 2.5
"""Points a square metre."""
_DIMENSION, _KINDS, _REPEATED = 128, 300, 0.15
"""This share of the points looks like one of so many kinds, wherever it is."""
_PIXEL_NOISE, _LOOK_NOISE, _FOUND, _MOST = 0.3, 0.03, 0.7, 250
"""Standard deviations of a pixel and of a descriptor's number, which is about 0.09; the chance that
a point in view is found; features of an image."""

_AXES = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


@dataclass(frozen=True)
class Campus:
    """Points (M, 3), metres, with looks (M, D); `wTc` (n, 4, 4) of the images, `time_ns` (n,).

    `free` tells of each cell of the plan, (rows, columns) from `corner` on, whether one sees
    through it.
    """

    points: F64
    looks: F32
    wTc: F64
    time_ns: I64
    free: Bools
    corner: F64
    seed: int

    def features(self) -> Iterator[Features]:
        """The features of each image, in order; the same whenever it is asked."""
        tree = cKDTree(self.points)
        rng = np.random.default_rng([self.seed, 1])
        for wTc in self.wTc:
            near = np.array(tree.query_ball_point(wTc[:3, 3], _SEEN_M), dtype=np.int64)
            yield self._seen(wTc, np.sort(near), rng)

    def _seen(self, wTc: F64, near: I64, rng: np.random.Generator) -> Features:
        local = (self.points[near] - wTc[:3, 3]) @ wTc[:3, :3]
        in_front = local[:, 2] > 0.3
        near, local = near[in_front], local[in_front]
        pixels = local[:, :2] / local[:, 2:] * [CAMERA.fx_px, CAMERA.fy_px]
        pixels += [CAMERA.cx_px, CAMERA.cy_px]
        size = np.array([CAMERA.width_px, CAMERA.height_px])
        inside = ((pixels > 4) & (pixels < size - 5)).all(axis=1) & (rng.random(len(near)) < _FOUND)
        near, pixels = near[inside], pixels[inside]
        open_ = self._unhidden(wTc[:2, 3], self.points[near, :2])
        near, pixels = near[open_], pixels[open_]
        chosen = rng.permutation(len(near))[:_MOST]  # in no order that tells a point
        pixels = pixels[chosen] + rng.normal(scale=_PIXEL_NOISE, size=(len(chosen), 2))
        looks = self.looks[near[chosen]]
        looks = looks + rng.normal(scale=_LOOK_NOISE, size=looks.shape).astype(np.float32)
        looks /= np.linalg.norm(looks, axis=1, keepdims=True)
        return Features(
            pixels.astype(np.float32), np.ones(len(chosen), np.float32), looks.astype(np.float32)
        )

    def _unhidden(self, eye: F64, points: F64) -> Bools:
        """Whether the straight way from the eye to a point on a wall (N, 2) is free, (N,)."""
        along = np.arange(_CELL_M, _SEEN_M, _CELL_M)
        way = points - eye
        length = np.linalg.norm(way, axis=1)
        at = eye + way[:, None] * (along / np.maximum(length[:, None], 1e-9))[..., None]
        cell = ((at - self.corner) / _CELL_M).astype(np.int64)
        cell = np.clip(cell, 0, np.array(self.free.shape) - 1)
        # The last cell before the wall may be the wall's.
        short = along >= length[:, None] - _CELL_M
        return np.asarray((self.free[cell[..., 0], cell[..., 1]] | short).all(axis=1))


def campus(images: int, seed: int) -> Campus:
    """A campus as large as a way of so many images needs."""
    rng = np.random.default_rng([seed, 0])
    nodes = _way(images, rng)
    wTc = _poses(nodes, images)
    edges = {tuple(sorted(pair)) for pair in itertools.pairwise(map(tuple, nodes.tolist()))}
    ends = np.array(sorted(edges), dtype=np.float64) * _GRID_M  # (E, 2, 2)
    low = ends.min(axis=1) - _WIDTH_M / 2
    high = ends.max(axis=1) + _WIDTH_M / 2
    crossings = np.unique(nodes, axis=0)
    halls = crossings[rng.random(len(crossings)) < _HALLS] * _GRID_M
    low = np.concatenate([low, halls - _HALL_M / 2])
    high = np.concatenate([high, halls + _HALL_M / 2])
    corner = low.min(axis=0) - 1.0
    free = np.zeros(np.ceil((high.max(axis=0) + 1.0 - corner) / _CELL_M).astype(int), dtype=bool)
    for first, last in zip(
        np.round((low - corner) / _CELL_M).astype(int),
        np.round((high - corner) / _CELL_M).astype(int),
        strict=True,
    ):
        free[first[0] : last[0], first[1] : last[1]] = True
    points = _points(free, corner, rng)
    looks = rng.normal(size=(len(points), _DIMENSION)).astype(np.float32)
    kinds = rng.normal(size=(_KINDS, _DIMENSION)).astype(np.float32)
    again = rng.random(len(points)) < _REPEATED
    looks[again] = kinds[rng.integers(0, _KINDS, int(again.sum()))]
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    time_ns = np.arange(images, dtype=np.int64) * 200_000_000
    return Campus(points, looks, wTc, time_ns, free, corner, seed)


def _way(images: int, rng: np.random.Generator) -> I64:
    """Crossings (K, 2) of the grid, one beside the next, long enough for the images."""
    wanted = int(np.ceil(images * _STEP_M / _GRID_M)) + 2
    # A square of k x k crossings has 2 k (k - 1) corridors.
    corridors = _NEW * images * _FORWARD_M / _GRID_M
    side = max(2, round((1 + np.sqrt(1 + 2 * corridors)) / 2))
    here, heading = np.array([side // 2, side // 2]), 0
    way, gone = [here], dict[tuple[int, ...], int]()
    while len(way) < wanted:
        turns = [turn for turn in (0, 1, 3) if _is_inside(here + _AXES[(heading + turn) % 4], side)]
        turns = turns or [2]
        # Where it went least, at random among equals; straight on a little rather than around.
        cost = [
            gone.get((*here, *_AXES[(heading + turn) % 4]), 0) + 0.5 * rng.random() + 0.1 * turn
            for turn in turns
        ]
        heading = (heading + turns[int(np.argmin(cost))]) % 4
        step = _AXES[heading]
        for key in ((*here, *step), (*(here + step), *-step)):
            gone[key] = gone.get(key, 0) + 1
        here = here + step
        way.append(here)
    return np.array(way)


def _is_inside(node: I64, side: int) -> bool:
    return bool((node >= 0).all() and (node < side).all())


def _poses(nodes: I64, images: int) -> F64:
    """Poses along the way (n, 4, 4), evenly by how far the camera moves and turns."""
    fine = 0.02
    along = np.arange(0, (len(nodes) - 1) * _GRID_M, fine)
    corners = np.arange(len(nodes)) * _GRID_M
    path = np.stack([np.interp(along, corners, nodes[:, k] * _GRID_M) for k in (0, 1)], axis=1)
    path = gaussian_filter1d(path, 0.6 / fine, axis=0, mode="nearest")  # nobody turns on the spot
    ahead = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    yaw = heading + np.radians(_GLANCE_DEG) * np.sin(2 * np.pi * along / _GLANCE_M)
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1) / _STEP_M
    moved += np.abs(np.diff(yaw)) / np.radians(_TURN_DEG)
    due = np.searchsorted(np.cumsum(moved), np.arange(images))
    place, yaw = path[due], yaw[due]
    height = _EYE_M + 0.15 * np.sin(along[due] / 2.0)
    x, y, zero = np.cos(yaw), np.sin(yaw), np.zeros(images)
    # Columns: the camera's right, down and forward in the world.
    rotation = np.array([[y, zero, x], [-x, zero, y], [zero, zero - 1, zero]])
    return poses.pose(np.moveaxis(rotation, 2, 0), np.column_stack([place, height]))


def _points(free: Bools, corner: F64, rng: np.random.Generator) -> F64:
    """Points (M, 3) on the walls, where free cells meet others, and on floor and ceiling."""
    found = []
    for axis, side in ((0, 1), (0, -1), (1, 1), (1, -1)):
        wall = np.argwhere(free & ~np.roll(free, -side, axis=axis))
        count = rng.poisson(_WALL_DENSITY * _CELL_M * _HEIGHT_M, len(wall))
        cell = np.repeat(wall, count, axis=0)
        at = (cell + rng.random(cell.shape)) * _CELL_M
        at[:, axis] = (cell[:, axis] + (side > 0)) * _CELL_M
        found.append(np.column_stack([at + corner, rng.uniform(0, _HEIGHT_M, len(at))]))
    for height in (0.0, _HEIGHT_M):
        inner = np.argwhere(free)
        cell = np.repeat(inner, rng.poisson(_OTHER_DENSITY * _CELL_M**2, len(inner)), axis=0)
        at = (cell + rng.random(cell.shape)) * _CELL_M + corner
        found.append(np.column_stack([at, np.full(len(at), height)]))
    return np.concatenate(found)
