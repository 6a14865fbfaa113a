"""Which landmarks a camera at a pose would see, and where, without looking at each of a large map.

Two indices: `LandmarkIndex` by place and `Covisibility` by the keyframes that saw landmarks
together (Alcantarilla et al., ICRA 2010), which also knows what hides behind a wall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse

from ground_station.arrays import F32, F64, I64, Bools, Indices
from ground_station.geometry import poses
from ground_station.geometry.camera import NEAREST_M, Camera
from ground_station.localization.settings import ProjectionSettings
from ground_station.map.store import Keyframes, Landmarks


@dataclass(frozen=True)
class Projected:
    """N landmarks in view: `landmark` (N,) indices; without lens, where they are seen on the plane
    z = 1, `normalized` (N, 2), and in pixels, `pinhole_px` (N, 2)."""

    landmark: Indices
    normalized: F64
    pinhole_px: F64


def project(
    landmarks: Landmarks,
    wTc: npt.ArrayLike,
    camera: Camera,
    settings: ProjectionSettings,
    among: Indices | None = None,
) -> Projected:
    """The landmarks that a camera at `wTc` (4, 4) would see.

    Those behind the camera or outside of its (distorted) image are dropped and, if the settings say
    so, those looked at from outside of their viewing cone (Alcantarilla et al., ICRA 2010). Only
    landmarks `among` (N,) are looked at, where given: those of `LandmarkIndex`.
    """
    cTw = poses.inverse(wTc)
    position_m = landmarks.position_m if among is None else landmarks.position_m[among]
    points = position_m @ cTw[:3, :3].T + cTw[:3, 3]
    front = np.flatnonzero(points[:, 2] > NEAREST_M)
    points = points[front]
    index = front if among is None else among[front]
    normalized = points[:, :2] / points[:, 2:]
    keep = camera.inside(normalized)
    index, normalized = index[keep], normalized[keep]
    if settings.viewing_cone and len(index):
        keep = _in_cone(landmarks, index, np.asarray(wTc)[:3, 3], settings)
        index, normalized = index[keep], normalized[keep]
    pixels = normalized * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    return Projected(index, normalized, pixels)


def _in_cone(
    landmarks: Landmarks, index: Indices, position_m: F64, settings: ProjectionSettings
) -> Bools:
    """Whether landmarks `index` (N,) are looked at from within their widened cones; (N,)."""
    beyond, ratio = _off_cone(landmarks, index, position_m)
    margin = np.deg2rad(settings.cone_margin_deg)
    return np.asarray((beyond <= margin) & (ratio <= settings.max_distance_ratio))


def _off_cone(landmarks: Landmarks, index: Indices, position_m: F64) -> tuple[F64, F64]:
    """How far outside of their cones landmarks `index` (N,) are looked at, radians, (N,), and how
    many times nearer or farther than keyframes were, (N,), from a place (3,) in the world."""
    rays = position_m - landmarks.position_m[index]
    distance = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
    cosine = np.einsum("ij,ij->i", rays, landmarks.view_direction[index]) / distance
    half = np.arccos(np.clip(landmarks.view_cos[index], -1.0, 1.0))
    beyond = np.arccos(np.clip(cosine, -1.0, 1.0)) - half
    nearest, farthest = landmarks.distance_m[index].T
    return np.asarray(beyond), np.asarray(np.maximum(nearest / distance, distance / farthest))


_HELD, _BEYOND = 0.75, 1.1
"""Cones widened for landmarks that are seen hold three in four of these, which wrong ones among
them hardly move, and a tenth more, as the camera moves on."""


def widened(
    settings: ProjectionSettings, landmarks: Landmarks, seen: Indices | None, position_m: F64
) -> ProjectionSettings:
    """The same, in whose cones landmarks `seen` (N,) are looked at from a place (3,).

    How far from its keyframes a landmark is known again differs with what is seen: a poster is
    from 70 degrees aside. Where some are, others of their kind are to be expected, too.
    """
    if not settings.viewing_cone or seen is None or not len(seen):
        return settings
    beyond, ratio = (
        _BEYOND * float(np.quantile(each, _HELD)) for each in _off_cone(landmarks, seen, position_m)
    )
    return replace(
        settings,
        cone_margin_deg=max(settings.cone_margin_deg, float(np.rad2deg(beyond))),
        max_distance_ratio=max(settings.max_distance_ratio, ratio),
    )


_CELL_M = 2.0
_CELLS_A_BLOCK = 8
"""Along each axis: blocks of 16 m keep the number of tests small in a map of 10⁶ landmarks."""

_SHARED = 0.1
"""Of the landmarks just seen, the share that a covisible keyframe saw as well,"""
_NEIGHBOURS, _NEIGHBOUR_M, _NEIGHBOUR_COS = 12, 4.0, 0.5
"""or it is one of the nearest to the pose that look the same way (60 degrees)."""
_FEWEST = 60
"""With fewer landmarks than this the keyframes know too little of the place."""

_SLACK_M = 1e-4
"""For rounding: a sphere that only touches the view counts as in it."""


@dataclass(frozen=True)
class _Spheres:
    """Bounding spheres of groups of consecutive points: group k is starts[k]:starts[k + 1]."""

    starts: Indices
    centre_m: F64
    radius_m: F64
    farthest_m: F64
    """The largest distance from which a keyframe saw a landmark of the group."""


class LandmarkIndex:
    """Landmarks in cells, cells in blocks; a block out of view costs one test for all of its."""

    def __init__(self, landmarks: Landmarks) -> None:
        """Takes positions as they are: landmarks that move need another index."""
        cell = np.floor(landmarks.position_m / _CELL_M).astype(np.int64)
        block = cell // _CELLS_A_BLOCK
        keys = [*cell.T, *block.T]
        self._order = np.lexsort(keys)
        position_m = landmarks.position_m[self._order]
        farthest_m = landmarks.distance_m[self._order, 1]
        self._cells = _bound(position_m, farthest_m, cell[self._order])
        self._blocks = _bound(position_m, farthest_m, block[self._order])
        # Where each block's cells begin among all cells.
        self._block_cells = np.searchsorted(self._cells.starts, self._blocks.starts)

    def near(self, wTc: npt.ArrayLike, camera: Camera, settings: ProjectionSettings) -> Indices:
        """Every landmark that `project` could keep from `wTc` (4, 4), and few others; sorted."""
        cTw = poses.inverse(wTc)
        blocks = _in_view(self._blocks, slice(None), cTw, camera, settings)
        cells = _ranges(self._block_cells[blocks], self._block_cells[blocks + 1])
        cells = cells[_in_view(self._cells, cells, cTw, camera, settings)]
        rows = _ranges(self._cells.starts[cells], self._cells.starts[cells + 1])
        return np.sort(self._order[rows])


class Covisibility:
    """Which landmarks were seen together: by keyframe, and keyframes by landmark."""

    def __init__(self, count: int, keyframes: Keyframes) -> None:
        """`count` landmarks, M, and the keyframes that observed them."""
        self._position_m = np.ascontiguousarray(keyframes.wTc[:, :3, 3])
        self._forward = np.ascontiguousarray(keyframes.wTc[:, :3, 2])
        self._count, self._offset = count, keyframes.offset
        self._landmark = keyframes.landmark
        seen = sparse.csr_matrix(
            (np.ones(len(keyframes.landmark), np.int8), keyframes.landmark, keyframes.offset),
            shape=(len(keyframes), count),
        ).tocsc()
        self._first, self._keyframe = seen.indptr, seen.indices

    def keyframes(self, recent: Indices, wTc: npt.ArrayLike) -> Indices:
        """The keyframes that share landmarks `recent` (N,), just seen, or are near wTc (4, 4)."""
        T = np.asarray(wTc, np.float64)
        rows = _ranges(self._first[recent], self._first[recent + 1])
        shared = np.bincount(self._keyframe[rows], minlength=len(self._position_m))
        chosen = shared >= max(_SHARED * len(recent), 1.0)
        distance = np.linalg.norm(self._position_m - T[:3, 3], axis=1)
        distance[self._forward @ T[:3, 2] < _NEIGHBOUR_COS] = np.inf
        nearest = np.argsort(distance, kind="stable")[:_NEIGHBOURS]
        chosen[nearest[distance[nearest] < _NEIGHBOUR_M]] = True
        return np.flatnonzero(chosen)

    def covisible(self, recent: Indices, wTc: npt.ArrayLike, among: Indices) -> Indices:
        """Of landmarks `among` (N,), those that covisible keyframes saw.

        `recent` (R,) are the landmarks seen just before, maybe none. When too few are left, all
        are given back: a place that the keyframes hardly know is searched without them.
        """
        chosen = self.keyframes(recent, wTc)
        seen = np.zeros(self._count, bool)
        seen[self._landmark[_ranges(self._offset[chosen], self._offset[chosen + 1])]] = True
        left = among[seen[among]]
        return left if len(left) >= _FEWEST else among


def _bound(position_m: F64, farthest_m: F32, group: I64) -> _Spheres:
    """Spheres around points (M, 3) that are sorted by their group's three indices (M, 3)."""
    if not len(position_m):
        none = np.empty(0)
        return _Spheres(np.zeros(1, np.intp), np.empty((0, 3)), none, none)
    changes = np.flatnonzero((group[1:] != group[:-1]).any(axis=1)) + 1
    begins = np.concatenate([[0], changes])
    starts = np.append(begins, len(position_m))
    low = np.minimum.reduceat(position_m, begins)
    centre_m = 0.5 * (low + np.maximum.reduceat(position_m, begins))
    offset = position_m - np.repeat(centre_m, np.diff(starts), axis=0)
    radius_m = np.sqrt(np.maximum.reduceat(np.einsum("ij,ij->i", offset, offset), begins))
    return _Spheres(
        starts, centre_m, radius_m, np.maximum.reduceat(farthest_m, begins).astype(np.float64)
    )


def _in_view(
    spheres: _Spheres,
    which: slice | Indices,
    cTw: F64,
    camera: Camera,
    settings: ProjectionSettings,
) -> Indices:
    """Of the spheres `which`, the indices of those that reach into the cone around the image.

    A sphere reaches into a cone of half angle θ about z when ρ·cos θ − z·sin θ is at most its
    radius, ρ the distance of its centre from the axis; near the apex that keeps some too many.
    """
    centre = spheres.centre_m[which] @ cTw[:3, :3].T + cTw[:3, 3]
    reach = spheres.radius_m[which] + _SLACK_M
    half = np.arctan(camera.max_radius)
    aside = np.hypot(centre[:, 0], centre[:, 1])
    keep = aside * np.cos(half) - centre[:, 2] * np.sin(half) <= reach
    keep &= centre[:, 2] + reach > NEAREST_M
    if settings.viewing_cone:
        limit = spheres.farthest_m[which] * settings.max_distance_ratio
        keep &= np.linalg.norm(centre, axis=1) - reach <= limit
    return np.flatnonzero(keep)


def _ranges(begins: Indices, ends: Indices) -> Indices:
    """The indices begins[0]..ends[0] − 1, begins[1]..ends[1] − 1, and so on, in one array."""
    lengths = ends - begins
    shift = begins - np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(begins) else begins
    return np.asarray(np.arange(int(lengths.sum())) + np.repeat(shift, lengths))
