"""Training pairs: two views of one place, each in its own light, and what is where in both.

A pair is a function of seed, step and place in the batch alone: where training stands in its data
is one number.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64, U8, Bools
from ground_station.feature_models.degrade import degrade
from ground_station.training.corpus import Corpus, Place
from ground_station.training.topology import CELL_PX, LOGITS
from ground_station.training.warps import WarpLimits, apply, inside, pair_of_views

# SuperPoint (DeTone et al., CVPR-W 2018, section 3.4) labels one pixel of a cell; here a point's
# weight is shared among the four pixels around it, so that its fraction of a pixel can be learned.


def confidence(scores: F32, low: float, high: float) -> F32:
    """The teacher's scores (N,) as chances that a point is one: a ramp from `low` to `high`."""
    return np.asarray(np.clip((scores - low) / (high - low), 0, 1), np.float32)


def soft_cells(points_px: F32, chances: F32, shape: tuple[int, int]) -> F32:
    """Labels (65, H/8, W/8) of points (N, 2), x then y, px, for a picture of `shape` (H, W).

    Channel k < 64 is pixel (k // 8, k % 8) of the cell, 64 is "none"; each cell sums to 1. Points
    out of the picture are left out; weight that falls on pixels beyond its edge is lost.
    """
    rows, columns = shape
    mass = np.zeros(rows * columns, np.float32)
    base = np.floor(points_px).astype(np.int64)
    part = points_px - base
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = base[:, 0] + dx, base[:, 1] + dy
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            share = np.where(dx, part[:, 0], 1 - part[:, 0])
            share = share * np.where(dy, part[:, 1], 1 - part[:, 1]) * chances
            np.add.at(mass, (y * columns + x)[inside], share[inside].astype(np.float32))
    h, w = rows // CELL_PX, columns // CELL_PX
    cells = mass.reshape(h, CELL_PX, w, CELL_PX).transpose(1, 3, 0, 2).reshape(-1, h, w)
    total = cells.sum(axis=0)
    result = np.empty((LOGITS, h, w), np.float32)
    result[:-1] = cells / np.maximum(total, 1)
    result[-1] = np.maximum(1 - total, 0)
    return result


Rng = np.random.Generator

_CHANCE_SCORES = (0.05, 0.35)
"""Average teacher scores at which a point counts nothing and wholly."""
_APART_PX = 3.0
"""In a view, two points nearer than this are one: the stronger stays."""
_MARGIN_PX = 4.0


@dataclass(frozen=True)
class Pair:
    """Two views and their truth; arrays of fixed shapes, so that pairs stack to batches.

    `images` (2, H, W) uint8; `labels` (2, 65, H/8, W/8) float16; `known` (2, H/8, W/8) bool: cells
    of which the labels say something; `points_px` (2, P, 2) float32, the same P points in both;
    `used` (P,) bool: the first so many are points; `teacher` (P, D) float16, nought where there is
    no descriptor; `second_from_first` (3, 3) float64.
    """

    images: U8
    labels: npt.NDArray[np.float16]
    known: Bools
    points_px: F32
    used: Bools
    teacher: npt.NDArray[np.float16]
    second_from_first: F64


def view_of(picture: U8, matrix: F64, size: tuple[int, int]) -> U8:
    """A view of (rows, columns) through `matrix`, from its pixels to the picture's."""
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    if scale > 1.1:  # smaller than the picture: what a view's pixel collects
        sigma = float(0.5 * np.sqrt(scale**2 - 1))
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma), np.uint8)
    return np.asarray(
        cv2.warpPerspective(
            picture, matrix, size[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT_101,
        ),
        np.uint8,
    )  # fmt: skip


def _known_cells(matrix: F64, picture: tuple[int, ...], size: tuple[int, int]) -> Bools:
    """Cells (h, w) of a view whose four corners lie well inside the picture."""
    y, x = np.meshgrid(
        np.arange(0, size[0] + 1, CELL_PX) - 0.5, np.arange(0, size[1] + 1, CELL_PX) - 0.5,
        indexing="ij",
    )  # fmt: skip
    corners = apply(matrix, np.stack([x.ravel(), y.ravel()], axis=1))
    good = inside(corners, (picture[0], picture[1]), _MARGIN_PX).reshape(x.shape)
    return np.asarray(good[:-1, :-1] & good[1:, :-1] & good[:-1, 1:] & good[1:, 1:])


def _thinned(points_px: F64) -> Bools:
    """Which points (N,), strongest first, have no stronger one nearer than `_APART_PX`."""
    keep = np.ones(len(points_px), bool)
    for a, b in sorted(cKDTree(points_px).query_pairs(_APART_PX)):
        if keep[a]:
            keep[b] = False
    return keep


def make_pair(
    place: Place, rng: Rng, size: tuple[int, int], points: int, strength: float = 1.0
) -> Pair:
    """Two views of (rows, columns), multiples of 8, with `points` pairs of points at most.

    Where teacher's points are too few, points by chance fill up: descriptors are for everywhere.
    """
    picture = place.views.shape[1:]
    matrices = pair_of_views(rng, (picture[0], picture[1]), size, WarpLimits(), strength)
    lights = rng.integers(0, len(place.views), 2)
    images, labels, known, places = [], [], [], []
    chances = confidence(place.scores, *_CHANCE_SCORES)
    for matrix, light in zip(matrices, lights.tolist(), strict=True):
        images.append(degrade(view_of(place.views[light], matrix, size), rng))
        at = apply(np.linalg.inv(matrix), place.points_px)
        seen = np.flatnonzero(inside(at, size, -0.5))
        strong = seen[_thinned(at[seen])]
        labels.append(soft_cells(at[strong].astype(np.float32), chances[strong], size))
        known.append(_known_cells(matrix, picture, size))
        places.append(at)
    second_from_first = np.linalg.inv(matrices[1]) @ matrices[0]
    second_from_first /= second_from_first[2, 2]
    both = np.flatnonzero(inside(places[0], size, _MARGIN_PX) & inside(places[1], size, _MARGIN_PX))
    both = rng.permutation(both)[:points]
    first = places[0][both] + rng.normal(0, 0.3, (len(both), 2))
    filling = rng.uniform(_MARGIN_PX, np.array(size[::-1]) - 1 - _MARGIN_PX, (points, 2))
    first = np.concatenate([first, filling])
    second = apply(second_from_first, first)
    base = apply(matrices[0], first)
    good = inside(second, size, _MARGIN_PX) & inside(base, (picture[0], picture[1]), _MARGIN_PX)
    chosen = np.flatnonzero(good)[:points]
    teacher = np.zeros((len(first), place.descriptors.shape[1]), np.float16)
    teacher[: len(both)] = place.descriptors[both]
    count = len(chosen)
    at_both = np.zeros((2, points, 2), np.float32)
    at_both[0, :count], at_both[1, :count] = first[chosen], second[chosen]
    vectors = np.zeros((points, teacher.shape[1]), np.float16)
    vectors[:count] = teacher[chosen]
    return Pair(
        images=np.stack(images),
        labels=np.stack(labels).astype(np.float16),
        known=np.stack(known),
        points_px=at_both,
        used=np.arange(points) < count,
        teacher=vectors,
        second_from_first=second_from_first,
    )


@dataclass(frozen=True)
class PairSource:
    """Pairs by step and place in the batch."""

    corpus: Corpus
    seed: int
    size: tuple[int, int]
    points: int

    def pair(self, step: int, index: int) -> Pair:
        """The same each time it is asked for."""
        rng = np.random.default_rng([self.seed, 5, step, index])
        place = self.corpus[int(rng.integers(len(self.corpus)))]
        # Some pairs differ in light only, as frames of a hovering blimp do.
        strength = float(rng.choice([0.1, 0.5, 1.0], p=[0.15, 0.35, 0.5]))
        return make_pair(place, rng, self.size, self.points, strength)
