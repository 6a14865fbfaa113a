"""Extractors on pairs of pictures in the Oxford layout, whose homographies are known.

Repeatability and matching accuracy are `homographic`'s, homography accuracy that of DeTone et al.,
"SuperPoint", CVPR-W 2018 (section 7 and appendix).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F32, F64, U8
from ground_station.errors import InputError
from ground_station.feature_models.homographic import NEAR_PX, Found, found_again, project
from ground_station.features.extractor import Extractor, Features
from ground_station.recording.folder import read_grey

CORNERS_PX = (1.0, 3.0, 5.0)
"""A homography is right when it moves the picture's corners less than this in the mean."""

_HOMOGRAPHY_FILE = re.compile(r"(.+)\.H(\d+)to(\d+)p")
_INLIER_PX = 3.0
_ITERATIONS, _CONFIDENCE = 5000, 0.9999


@dataclass(frozen=True)
class Pair:
    """Two grey pictures (H, W) uint8 and the homography (3, 3) from the first's pixels."""

    name: str
    first: U8
    second: U8
    homography: F64


@dataclass(frozen=True)
class Score:
    """What one extractor does on one pair.

    `keypoints` counts both pictures'. `corners_px` is the mean distance of the first picture's
    corners by the homography that the matches give; infinite where they give none.
    """

    pair: str
    keypoints: tuple[int, int]
    found: Found
    corners_px: float

    def document(self) -> dict[str, Any]:
        """As plain values: `seen` points in view of both, `repeated` of them found again."""
        return {
            "pair": self.pair,
            "keypoints": self.keypoints,
            "seen": len(self.found.nearest_px),
            "repeated": int(np.sum(self.found.nearest_px <= NEAR_PX)),
            "matches": len(self.found.matches),
            "correct": self.found.correct,
            "corners_px": self.corners_px,
        }


def read_pairs(folder: str | Path) -> list[Pair]:
    """The pairs of a folder in the Oxford layout: `NAME1.png`, `NAME2.png`, `NAME.H1to2p`.

    Raises `InputError` with one line for a folder without pairs, a picture that is missing or no
    picture, and a file that holds no homography.
    """
    folder = Path(folder)
    pairs = []
    for path in sorted(folder.glob("*.H*to*p")):
        if match := _HOMOGRAPHY_FILE.fullmatch(path.name):
            name, i, j = match.groups()
            first, second = (read_grey(folder / f"{name}{k}.png") for k in (i, j))
            pairs.append(Pair(f"{name} {i}-{j}", first, second, _homography(path)))
    if not pairs:
        raise InputError(f"{folder}: there are no pairs (NAME1.png, NAME2.png, NAME.H1to2p)")
    return pairs


def _homography(path: Path) -> F64:
    try:
        H = np.array(path.read_text().split(), np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or 'no numbers'}") from None
    if H.size != 9 or not np.isfinite(H).all() or abs(np.linalg.det(H.reshape(3, 3))) < 1e-12:
        raise InputError(f"{path}: not the nine numbers of a homography")
    return H.reshape(3, 3)


def measure(extractor: Extractor, pairs: Sequence[Pair]) -> list[Score]:
    """The scores of an extractor on each pair."""
    return [
        score(extractor.extract(pair.first), extractor.extract(pair.second), pair) for pair in pairs
    ]


def score(first: Features, second: Features, pair: Pair) -> Score:
    """The score of the features of a pair's two pictures."""
    shapes = pair.first.shape, pair.second.shape
    found = found_again(first, second, pair.homography, shapes)
    p, q = first.keypoints_px[found.matches[:, 0]], second.keypoints_px[found.matches[:, 1]]
    return Score(pair.name, (len(first), len(second)), found, _corners_px(p, q, pair))


def _corners_px(p: F32, q: F32, pair: Pair) -> float:
    if len(p) < 4:
        return float("inf")
    try:
        H, _ = cv2.findHomography(p, q, cv2.USAC_MAGSAC, _INLIER_PX, None, _ITERATIONS, _CONFIDENCE)
    except cv2.error:  # a degenerate sample
        return float("inf")
    if H is None:
        return float("inf")
    height, width = pair.first.shape
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]])
    apart = project(np.asarray(H, np.float64), corners) - project(pair.homography, corners)
    mean = float(np.linalg.norm(apart, axis=1).mean())
    return mean if np.isfinite(mean) else float("inf")


def summary(scores: Sequence[Score]) -> dict[str, Any]:
    """The means over all pairs, the share of correct matches by scene, and each pair's counts."""
    scenes: dict[str, list[float]] = {}
    for score in scores:  # by the name before the numbers
        scenes.setdefault(score.pair.partition(" ")[0], []).append(score.found.accuracy)
    corners = np.array([score.corners_px for score in scores])
    return {
        "repeatability": _mean([score.found.repeatability for score in scores]),
        "accuracy": _mean([score.found.accuracy for score in scores]),
        "scenes": {scene: _mean(accuracy) for scene, accuracy in scenes.items()},
        "homography": {f"{px:g}": float(np.mean(corners <= px)) for px in CORNERS_PX},
        "keypoints": _mean([float(np.mean(score.keypoints)) for score in scores]),
        "pairs": [score.document() for score in scores],
    }


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
