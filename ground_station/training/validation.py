"""What an extractor is worth on pairs that training never saw: the file that ships is what is run.

Repeatability and the share of correct matches as in the papers' tables; see
`feature_models.homographic` for what counts as a match.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ground_station.feature_models.homographic import NEAR_PX, compared
from ground_station.features.extractor import Extractor
from ground_station.training.pairs import Batch


@dataclass(frozen=True)
class Figures:
    """Means over pairs: `accuracy` the share of mutual nearest matches that are within 3 px,
    `correct` their number; `repeatability` the share of key points in both views' common part that
    lie within 3 px of one of the other's; `error_px` their median distance."""

    accuracy: float
    correct: float
    repeatability: float
    error_px: float


def figures(extractor: Extractor, pairs: Batch) -> Figures:
    """How well an extractor finds a view's key points again in the other; no lens may bend them."""
    images = (pairs.images[:, 0] * 255).round().to(torch.uint8).numpy()
    matrices = (pairs.views.from_picture[1::2] @ pairs.views.to_picture[::2]).double().numpy()
    found = [
        compared(extractor, images[2 * k], images[2 * k + 1], matrix / matrix[2, 2])
        for k, matrix in enumerate(matrices)
    ]
    pooled = np.concatenate([each.nearest_px for each in found])
    pooled = pooled[pooled <= NEAR_PX]
    return Figures(
        accuracy=float(np.mean([each.accuracy for each in found])),
        correct=float(np.mean([each.correct for each in found])),
        repeatability=float(np.mean([each.repeatability for each in found])),
        error_px=float(np.median(pooled)) if len(pooled) else float("nan"),
    )
