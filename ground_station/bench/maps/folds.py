"""Whether a map is true: which of its images are where they were taken, and what the build said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import GeometryError
from ground_station.geometry import poses
from ground_station.geometry.alignment import align
from ground_station.mapping.sfm import robust_similarity

MISPLACED_DEPTH, MISPLACED_DEG = 0.05, 5.0
"""An image is misplaced when it is off by more than this share of the median depth of what the
map's images see, or is turned by more than this: far more than an error of measurement (a pixel at
500 px of focal length is 0.2 % of a depth), and less than the steps at which walls repeat."""


@dataclass(frozen=True)
class Judgement:
    """Errors of the centres after a similarity, metres; `misplaced` are `images` of the map."""

    registered: int
    median_m: float
    max_m: float
    rmse_m: float
    bound_m: float
    misplaced: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def judge(names: list[str], wTc: F64, true: F64, depth: float, seed: int = 0) -> Judgement:
    """Poses `wTc` (K, 4, 4) of the images `names` against the true ones, (K, 4, 4), metres.

    `depth`, the median of what the images see, is in the units of `wTc`. The similarity is the one
    that most images agree on (LO-RANSAC, then least squares of those), so that a part that is
    folded over does not bend the rest. Where none is found, all images are misplaced.
    """
    source, target = wTc[:, :3, 3], true[:, :3, 3]
    none = Judgement(len(names), np.nan, np.nan, np.nan, np.nan, tuple(names))
    if len(names) < 3:
        return none
    # Metres to a unit, for the bound: distances between centres, of which most are right.
    i, j = np.triu_indices(len(names), 1)
    apart = np.linalg.norm(source[i] - source[j], axis=1)
    true_apart = np.linalg.norm(target[i] - target[j], axis=1)
    far = (apart > 0) & (true_apart > 0)
    if not far.any() or not depth > 0:
        return none
    bound_m = MISPLACED_DEPTH * depth * float(np.median(true_apart[far] / apart[far]))
    found = robust_similarity.similarity(source, target, bound_m, seed)
    if found is None:
        return none
    near = np.linalg.norm(found.apply(source) - target, axis=1) <= bound_m
    try:
        found = align(source[near], target[near], True)
    except GeometryError:
        return none
    bound_m = MISPLACED_DEPTH * depth * found.scale
    placed = found.apply_poses(wTc)
    off_m = np.linalg.norm(placed[:, :3, 3] - target, axis=1)
    turned = np.degrees(
        [float(poses.rotation_angle(a.T @ b)) for a, b in zip(placed[:, :3, :3], true[:, :3, :3],
                                                               strict=True)]
    )  # fmt: skip
    wrong = (off_m > bound_m) | (turned > MISPLACED_DEG)
    return Judgement(
        len(names), float(np.median(off_m)), float(off_m.max()),
        float(np.sqrt(np.mean(off_m**2))), bound_m,
        tuple(name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong),
    )  # fmt: skip


def said(built: Mapping[str, Any]) -> dict[str, int]:
    """How many doubts, parts kept apart and images left out a build names in `map.toml`."""
    return {key: len(built.get(key) or ()) for key in ("doubts", "parts", "left_out")}


def is_silent_fold(judged: Judgement, told: Mapping[str, int]) -> bool:
    """Whether images are misplaced and the build has neither a doubt nor kept parts of it apart."""
    return bool(judged.misplaced) and not (told["doubts"] or told["parts"])
