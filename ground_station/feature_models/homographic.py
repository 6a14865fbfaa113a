"""Features of two pictures whose homography is known, as that of a picture and a warp of it.

The measures are those of the HPatches literature: repeatability of DeTone et al., "SuperPoint",
CVPR-W 2018 (section 7 and appendix), matching accuracy of Dusmanu et al., "D2-Net", CVPR 2019
(section 4.1: the share of mutual nearest neighbours within 3 px).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ground_station.arrays import F64, I32, U8, Bools
from ground_station.features.extractor import Extractor, Features
from ground_station.mapping.construction.matching import mutual_matches

NEAR_PX = 3.0
"""A key point is found again, and a match is correct, up to this distance."""
_SHIFT = 0.2
"""How far a corner of what the second picture shows lies inside the first, of its sides."""


@dataclass
class Matching:
    """Counts over pairs of pictures, and each pair's share of correct matches."""

    correct: int
    matches: int
    shares: list[float]

    @property
    def accuracy(self) -> float:
        """The mean share of mutual nearest matches that are within `NEAR_PX`."""
        return float(np.mean(self.shares)) if self.shares else 0.0


def warp(image: U8, random: np.random.Generator) -> tuple[U8, F64]:
    """A view of an inner quadrangle of a picture (H, W), as large, and the H (3, 3) to it.

    H takes (x, y, 1) of the first to the second. No part of the second is made up.
    """
    height, width = image.shape
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64) * (width - 1, height - 1)
    inward = random.uniform(0, _SHIFT, (4, 2)) * (width - 1, height - 1)
    inner = corners + np.where(corners > 0, -inward, inward)
    matrix = cv2.getPerspectiveTransform(inner.astype(np.float32), corners.astype(np.float32))
    warped = cv2.warpPerspective(image, matrix, (width, height), flags=cv2.INTER_AREA)
    return np.asarray(warped, np.uint8), np.asarray(matrix, np.float64)


@dataclass(frozen=True)
class Found:
    """What of two pictures' key points is found again, by their homography.

    `nearest_px` (N,) is from each key point that lies in what both pictures show, of both, to the
    other picture's nearest; `matches` (M, 2) are mutual nearest neighbours of all key points, as
    rows of both, and `apart_px` (M,) how far each is from where it should be.
    """

    nearest_px: F64
    matches: I32
    apart_px: F64

    @property
    def repeatability(self) -> float:
        """The share of points in view that are found again; 0 of none."""
        return int(np.sum(self.nearest_px <= NEAR_PX)) / max(len(self.nearest_px), 1)

    @property
    def correct(self) -> int:
        """How many of the matches are where they should be."""
        return int(np.sum(self.apart_px <= NEAR_PX))

    @property
    def accuracy(self) -> float:
        """The share of matches that are correct; 0 of none."""
        return self.correct / max(len(self.matches), 1)


def found_again(
    first: Features, second: Features, H: F64, shapes: Sequence[tuple[int, ...]]
) -> Found:
    """What `first` and `second` have in common; H (3, 3) takes one to the other.

    `shapes` are the pictures' (H, W).
    """
    there = project(H, first.keypoints_px)
    back = project(np.asarray(np.linalg.inv(H)), second.keypoints_px)
    seen = there[_inside(there, shapes[1])]
    others = second.keypoints_px[_inside(back, shapes[0])].astype(np.float64)
    matches = mutual_matches(first.descriptors, second.descriptors, 1.0)
    apart = there[matches[:, 0]] - second.keypoints_px[matches[:, 1]]
    return Found(
        np.concatenate([_nearest_px(seen, others), _nearest_px(others, seen)]),
        matches,
        np.linalg.norm(apart, axis=1),
    )


def project(H: F64, points_px: npt.ArrayLike) -> F64:
    """Points (N, 2) through a homography; not finite on its horizon."""
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    x = points @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(x[:, :2] / x[:, 2:])


def _inside(points_px: F64, shape: tuple[int, ...]) -> Bools:
    return np.asarray(((points_px >= 0) & (points_px <= (shape[1] - 1, shape[0] - 1))).all(axis=1))


def _nearest_px(points: F64, others: F64) -> F64:
    """From each of the points to the nearest of the others."""
    if not len(points) or not len(others):
        return np.full(len(points), np.inf)
    return np.asarray(cKDTree(others).query(points)[0])


def compared(extractor: Extractor, first: U8, second: U8, H: F64) -> Found:
    """What an extractor finds again in the second of two pictures (H, W)."""
    both = extractor.extract(first), extractor.extract(second)
    return found_again(*both, H, (first.shape, second.shape))


def matching(extractor: Extractor, pairs: list[tuple[U8, U8, F64]]) -> Matching:
    """How well an extractor's key points are found again, by mutual nearest descriptors."""
    found = [compared(extractor, *pair) for pair in pairs]
    matches = sum(len(each.matches) for each in found)
    return Matching(sum(each.correct for each in found), matches, [each.accuracy for each in found])
