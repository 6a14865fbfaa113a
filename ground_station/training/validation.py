"""What an extractor is worth on pairs that training never saw: the file that ships is what is run.

Repeatability and the share of correct matches as in the papers' tables; see
`importing.homographic` for what counts as a match.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ground_station.arrays import F64
from ground_station.feature_models.homographic import LIMIT_PX, correct_matches
from ground_station.features.extractor import Extractor, Features
from ground_station.training.pairs import Pair


@dataclass(frozen=True)
class Figures:
    """Means over pairs: `accuracy` the share of mutual nearest matches that are within 3 px,
    `correct` their number; `repeatability` the share of key points in both views' common part that
    lie within 3 px of one of the other's; `error_px` their median distance."""

    accuracy: float
    correct: float
    repeatability: float
    error_px: float


def figures(extractor: Extractor, pairs: list[Pair]) -> Figures:
    """How well an extractor finds a view's key points again in the other."""
    accuracies, numbers, repeated, errors = [], [], [], []
    for pair in pairs:
        first, second = (extractor.extract(image) for image in pair.images)
        matrix = pair.second_from_first
        correct, matches = correct_matches(first, second, matrix, pair.images[1].shape)
        accuracies.append(correct / matches if matches else 0.0)
        numbers.append(correct)
        forth = _distances(first, second, matrix, pair.images[1].shape)
        back = _distances(
            second, first, np.asarray(np.linalg.inv(matrix), np.float64), pair.images[0].shape
        )
        distances = np.concatenate([forth, back])
        near = distances <= LIMIT_PX
        repeated.append(float(near.mean()) if len(near) else 0.0)
        errors.append(distances[near])
    pooled = np.concatenate(errors)
    return Figures(
        accuracy=float(np.mean(accuracies)),
        correct=float(np.mean(numbers)),
        repeatability=float(np.mean(repeated)),
        error_px=float(np.median(pooled)) if len(pooled) else float("nan"),
    )


def _distances(one: Features, other: Features, matrix: F64, shape: tuple[int, ...]) -> F64:
    """From each key point that the other view shows, to the other's nearest there, px."""
    if not len(one):
        return np.empty(0)
    points = cv2.perspectiveTransform(one.keypoints_px[None].astype(np.float64), matrix)[0]
    seen = np.all((points >= 0) & (points <= (shape[1] - 1, shape[0] - 1)), axis=1)
    if not len(other):
        return np.full(int(seen.sum()), np.inf)
    gaps = np.linalg.norm(points[seen][:, None] - other.keypoints_px[None], axis=2)
    return np.asarray(gaps.min(axis=1), np.float64)
