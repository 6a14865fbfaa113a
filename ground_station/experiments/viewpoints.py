"""What is expected to be seen from where: a map's keyframes, and places between and beside them.

A map that is chosen for its keyframes alone serves flights on the mapping path. So each keyframe
stands for views near it, too, whose landmarks are those that it and its neighbours saw.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from ground_station.arrays import F32, F64, I32, I64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.inspection.visibility import PRIOR, View
from ground_station.map.store import Map

CELLS = (8, 6)
"""Columns and rows that a picture is divided into."""

_NEIGHBOURS = 6
"""Keyframes that saw most of the same landmarks, the keyframe itself among them."""
_TURN_RAD = np.deg2rad(15.0)
"""A view beside a keyframe is turned so far left or right,"""
_SHARE = 0.25
"""and counts this much of it: the four beside a keyframe together count as one."""


@dataclass(frozen=True)
class ExpectedObservations:
    """Landmarks that V views are expected to show.

    Of each of E observations: `view` (E,), `cell` (E,), the picture's cell it falls in, counted
    through all views, `landmark` (E,) and `chance` (E,) that it is found; `weight` (V,) of the
    views."""

    view: I32
    cell: I32
    landmark: I32
    chance: F32
    weight: F64

    @property
    def cells(self) -> int:
        """Cells of all views."""
        return len(self.weight) * CELLS[0] * CELLS[1]


def expected_observations(
    map_: Map, step: Callable[[], None] = lambda: None
) -> ExpectedObservations:
    """Of a map's K keyframes, the first K views, and of views between and beside them.

    A landmark's chance is that of the neighbours which saw it among those in whose picture it lies,
    as in `inspection.visibility`: a keyframe, too, may have seen by luck what is hardly ever
    found. A keyframe weighs less by those that saw the same, so that a place counts once however
    long one stayed. `step` is called for each keyframe."""
    camera, cells = map_.info.camera, CELLS[0] * CELLS[1]
    shared = _shared(map_)
    weight = _alone(shared).tolist()
    rows: list[tuple[I32, I32, I32, F32]] = []
    for k, near in enumerate(_surroundings(map_, shared)):
        for place, wTc in enumerate(near.views):
            number = len(weight) if place else k
            if place:
                weight.append(_SHARE * weight[k])
            index, pixel = near.seen_from(wTc)
            cell = (number * cells + _cell(pixel, camera)).astype(np.int32)
            view = np.full(len(index), number, np.int32)
            rows.append((view, cell, near.landmark[index], near.chance[index]))
        step()
    view, cell, landmark, chance = map(np.concatenate, zip(*rows, strict=True))
    return ExpectedObservations(view, cell, landmark, chance, np.array(weight))


@dataclass(frozen=True)
class _Surrounding:
    """A keyframe's and other views (N, 4, 4) there, and what its neighbours saw of landmarks."""

    views: F64
    landmark: I32
    position: F64
    chance: F32
    view: View

    def seen_from(self, wTc: F64) -> tuple[I64, F64]:
        """Which of the landmarks lie in a view's picture, and at which distorted pixel (n, 2)."""
        local = poses.transform(poses.inverse(wTc), self.position)
        index = np.flatnonzero(self.view.inside(local))
        return index, self.view.camera.project(local[index])


def _shared(map_: Map) -> sparse.csr_matrix:
    """How many landmarks each two of K keyframes both saw (K, K)."""
    kf = map_.keyframes
    seen = sparse.csr_matrix(
        (np.ones(len(kf.landmark), np.int32), kf.landmark, kf.offset),
        shape=(len(kf), len(map_.landmarks)),
    )
    return (seen @ seen.T).tocsr()


def _alone(shared: sparse.csr_matrix) -> F64:
    """One over how many keyframes each is like (K,), itself counted: by the cosine of their
    observations.

    One that saw nothing is 1.
    """
    length = np.sqrt(np.maximum(shared.diagonal().astype(np.float64), 1))
    alike = shared.multiply(1 / length[:, None]).multiply(1 / length[None]).sum(axis=1)
    return np.asarray(1 / np.maximum(np.asarray(alike, np.float64).ravel(), 1))


def _surroundings(map_: Map, shared: sparse.csr_matrix) -> Iterator[_Surrounding]:
    """Those of each keyframe of a map; a view half way between two is made once."""
    kf, view = map_.keyframes, View.of(map_)
    paired: set[tuple[int, int]] = set()
    for k in range(len(kf)):
        row = slice(shared.indptr[k], shared.indptr[k + 1])
        others, count = shared.indices[row], shared.data[row]
        # Itself first, and then those that share most landmarks with it.
        order = np.lexsort((others, -count, others != k))
        group = np.array([k, *others[order][others[order] != k][: _NEIGHBOURS - 1].tolist()])
        views = [kf.wTc[k], *_beside(kf.wTc[k], kf.wTc[group[1:]])]
        if len(group) > 1:
            nearest = int(group[1])
            pair = min(k, nearest), max(k, nearest)
            if pair not in paired:
                paired.add(pair)
                views.append(poses.interpolate(kf.wTc[k], kf.wTc[nearest], 0.5))
        yield _surrounding(map_, view, group, np.array(views))


def _beside(wTc: F64, neighbours: F64) -> list[F64]:
    """The pose turned left and right, and moved aside as far as its neighbours (N, 4, 4) are."""
    made = [wTc @ poses.exp([0, sign * _TURN_RAD, 0, 0, 0, 0]) for sign in (-1, 1)]
    if len(neighbours):
        aside = float(np.median(np.linalg.norm(neighbours[:, :3, 3] - wTc[:3, 3], axis=1)))
        made += [wTc @ poses.exp([0, 0, 0, sign * aside, 0, 0]) for sign in (-1, 1)]
    return made


def _surrounding(map_: Map, view: View, group: I64, views: F64) -> _Surrounding:
    kf = map_.keyframes
    observations = [kf.landmark[kf.offset[n] : kf.offset[n + 1]] for n in group.tolist()]
    landmark, found = np.unique(np.concatenate(observations), return_counts=True)
    points = map_.landmarks.position_m[landmark]
    could = np.zeros(len(landmark))
    for n, mine in zip(group.tolist(), observations, strict=True):
        local = poses.transform(poses.inverse(kf.wTc[n]), points)
        # An observation at the border may project just outside: it was seen all the same.
        could += view.inside(local) | np.isin(landmark, mine)
    chance = (found / (could + PRIOR)).astype(np.float32)
    return _Surrounding(views, landmark, points, chance, view)


def _cell(pixel_px: npt.NDArray[np.floating], camera: Camera) -> I64:
    """The cells (N,) of distorted pixels (N, 2), row by row."""
    columns, rows = CELLS
    x = np.clip(pixel_px[:, 0] / camera.width_px * columns, 0, columns - 1).astype(np.int64)
    y = np.clip(pixel_px[:, 1] / camera.height_px * rows, 0, rows - 1).astype(np.int64)
    return np.asarray(y * columns + x, np.int64)
