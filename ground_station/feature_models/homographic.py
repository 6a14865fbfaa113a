"""Matching accuracy under known homographies: a picture and a warp of it, where truth is known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ground_station.arrays import F32, F64, U8, Indices
from ground_station.features.extractor import Extractor, Features

LIMIT_PX = 3.0
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
        """The mean share of mutual nearest matches that are within `LIMIT_PX`."""
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


def matching(extractor: Extractor, pairs: list[tuple[U8, U8, F64]]) -> Matching:
    """How well an extractor's key points are found again, by mutual nearest descriptors."""
    result = Matching(0, 0, [])
    for first, second, matrix in pairs:
        correct, matches = correct_matches(
            extractor.extract(first), extractor.extract(second), matrix, second.shape
        )
        result.correct += correct
        result.matches += matches
        result.shares.append(correct / matches if matches else 0.0)
    return result


def correct_matches(
    first: Features, second: Features, matrix: F64, shape: tuple[int, ...]
) -> tuple[int, int]:
    """The mutual nearest matches within `LIMIT_PX`, and all, of what both pictures show.

    `matrix` takes the first picture to the second, whose shape is (H, W).
    """
    if not len(first):
        return 0, 0
    points = cv2.perspectiveTransform(first.keypoints_px[None].astype(np.float64), matrix)
    there = points.reshape(-1, 2)
    seen = np.all((there >= 0) & (there <= (shape[1] - 1, shape[0] - 1)), axis=1)
    there, descriptors = there[seen], first.descriptors[seen]
    if not len(there) or not len(second):
        return 0, 0
    one, other = mutual_nearest(descriptors, second.descriptors)
    distance = np.linalg.norm(there[one] - second.keypoints_px[other], axis=1)
    return int(np.count_nonzero(distance <= LIMIT_PX)), len(one)


def mutual_nearest(first: F32, second: F32) -> tuple[Indices, Indices]:
    """Rows (N,) of unit descriptors (A, D), and rows (N,) of (B, D), each the other's nearest.

    A and B are at least 1.
    """
    likeness = first @ second.T
    forth, back = likeness.argmax(axis=1), likeness.argmax(axis=0)
    mutual = np.flatnonzero(back[forth] == np.arange(len(forth)))
    return mutual, forth[mutual]
