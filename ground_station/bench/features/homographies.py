"""Features of two pictures whose homography is known.

The measures are those of the HPatches literature: repeatability and homography accuracy of DeTone
et al., "SuperPoint", CVPR-W 2018 (section 7 and appendix), matching accuracy of Dusmanu et al.,
"D2-Net", CVPR 2019 (section 4.1: the share of mutual nearest neighbours within 3 px).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ground_station.arrays import F32, F64, U8, Bools
from ground_station.errors import InputError
from ground_station.features.extractor import Extractor, Features
from ground_station.mapping.construction.matching import mutual_matches
from ground_station.recording.folder import read_grey

NEAR_PX = 3.0
"""A key point is found again, and a match is correct, up to this distance."""
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

    `seen` are the key points that lie in what both pictures show, of both; `repeated` those of
    them with one of the other picture's within `NEAR_PX`. `correct` of `matches` mutual nearest
    neighbours, of all key points, lie within `NEAR_PX`. `corners_px` is the mean distance of the
    first picture's corners by the homography that the matches give; infinite where they give none.
    """

    pair: str
    keypoints: tuple[int, int]
    seen: int
    repeated: int
    matches: int
    correct: int
    corners_px: float

    @property
    def repeatability(self) -> float:
        """The share of points in view that are found again; 0 of none."""
        return self.repeated / max(self.seen, 1)

    @property
    def accuracy(self) -> float:
        """The share of matches that are correct; 0 of none."""
        return self.correct / max(self.matches, 1)


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
    there = project(pair.homography, first.keypoints_px)
    back = project(np.asarray(np.linalg.inv(pair.homography)), second.keypoints_px)
    in_second, in_first = _inside(there, pair.second.shape), _inside(back, pair.first.shape)
    seen = there[in_second], second.keypoints_px[in_first].astype(np.float64)
    matches = mutual_matches(first.descriptors, second.descriptors, 1.0)
    p, q = first.keypoints_px[matches[:, 0]], second.keypoints_px[matches[:, 1]]
    apart = np.linalg.norm(there[matches[:, 0]] - q, axis=1)
    return Score(
        pair=pair.name,
        keypoints=(len(first), len(second)),
        seen=len(seen[0]) + len(seen[1]),
        repeated=_near(seen[0], seen[1]) + _near(seen[1], seen[0]),
        matches=len(matches),
        correct=int(np.sum(apart <= NEAR_PX)),
        corners_px=_corners_px(p, q, pair),
    )


def project(H: F64, points_px: npt.ArrayLike) -> F64:
    """Points (N, 2) through a homography; not finite on its horizon."""
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    x = points @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(x[:, :2] / x[:, 2:])


def _inside(points_px: F64, shape: tuple[int, ...]) -> Bools:
    return np.asarray(((points_px >= 0) & (points_px <= (shape[1] - 1, shape[0] - 1))).all(axis=1))


def _near(points: F64, others: F64) -> int:
    """How many of the points have one of the others within `NEAR_PX`."""
    if not len(points) or not len(others):
        return 0
    distance, _ = cKDTree(others).query(points)
    return int(np.sum(distance <= NEAR_PX))


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
    scenes = dict.fromkeys(_scene(score) for score in scores)
    corners = np.array([score.corners_px for score in scores])
    return {
        "repeatability": _mean([score.repeatability for score in scores]),
        "accuracy": _mean([score.accuracy for score in scores]),
        "scenes": {
            scene: _mean([s.accuracy for s in scores if _scene(s) == scene]) for scene in scenes
        },
        "homography": {f"{px:g}": float(np.mean(corners <= px)) for px in CORNERS_PX},
        "keypoints": _mean([float(np.mean(score.keypoints)) for score in scores]),
        "pairs": [vars(score) for score in scores],
    }


def _scene(score: Score) -> str:
    """What several pairs have in common: the name before its numbers."""
    return score.pair.partition(" ")[0]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
