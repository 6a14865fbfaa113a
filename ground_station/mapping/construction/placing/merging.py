"""Models that structure from motion left apart: joined where pairs say how, else reported.

What joins two models are landmarks that both have: of an image that is in both, and of verified
pairs between an image of the one and one of the other. A similarity must take most of the one
model's landmarks onto the other's, and no second one may do nearly as well: a corridor fits itself
again one door further on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.errors import GeometryError
from ground_station.geometry.alignment import Alignment, align
from ground_station.map import colmap
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.sfm import robust_similarity
from ground_station.mapping.sfm.two_view import TwoView

_WITHIN_DEPTHS = 0.05
"""A landmark of both models is the same place so exactly, in distances at which they are seen."""
_FEWEST = 30
"""Landmarks in common that join two models."""
_MOST = 0.5
"""Of the landmarks in common that one similarity must fit. Of a simulated walk's chain models, true
junctions had 0.6 and 0.97, look-alikes 0.26 and, of 127, 0.51: so this alone does not tell
them, and the most certain are joined first."""
SECOND = 0.5
"""A second similarity that fits so many of the first one's number makes it doubtful."""
_SHOWN = 4
"""Ranges of names that a report lists."""


@dataclass(frozen=True)
class Junction:
    """The similarity that takes a model to another; without one, in words, what is missing.

    `landmarks`: how many it fits.
    """

    similarity: Alignment | None
    missing: str = ""
    landmarks: int = 0


def junction(target: Placed, source: Placed, pairs: Mapping[Pair, TwoView], seed: int) -> Junction:
    """How `source` is joined to `target`, by the landmarks that both have."""
    x, y, links = _common(target, source, pairs)
    if not links:
        return Junction(None, "no pair links them to the largest")
    within = _WITHIN_DEPTHS * target.depth
    similarity, fits = _similarity(x, y, within, seed)
    first = np.count_nonzero(fits)
    fewest = max(_FEWEST, int(np.ceil(_MOST * len(x))))
    if similarity is None or first < fewest:
        return Junction(
            None,
            f"{links} pairs or images link them to the largest, but {first} of {len(x)} landmarks "
            f"in common fit together, {fewest} must",
        )
    other, others = _similarity(x[~fits], y[~fits], within, seed)
    second = np.count_nonzero(others)
    if other is not None and second >= SECOND * first:
        return Junction(
            None,
            f"they fit the largest in two places: {first} landmarks say one, {second} another",
        )
    return Junction(similarity, landmarks=int(first))


def describe(model: colmap.Reconstruction, names: Sequence[str], missing: str) -> str:
    """The line that says which images form a model of their own, and what is missing."""
    index = np.array(sorted(model.reg_image_ids()), dtype=np.int64) - 1
    runs = np.split(index, np.flatnonzero(np.diff(index) > 1) + 1)
    ranges = [
        names[run[0]] if len(run) == 1 else f"{names[run[0]]} to {names[run[-1]]}" for run in runs
    ]
    if len(ranges) > _SHOWN:
        ranges[_SHOWN:] = [f"{len(ranges) - _SHOWN} more"]
    return f"{', '.join(ranges)}: {len(index)} images form a model of their own: {missing}"


def poses_in(source: Placed, similarity: Alignment, without: set[int]) -> dict[int, F64]:
    """Where a model's images, but for some, are in the other model, by COLMAP's id: index + 1."""
    index = [k for k in source.wTc if k not in without]
    if not index:
        return {}
    moved = similarity.apply_poses(np.array([source.wTc[k] for k in index]))
    return {k + 1: pose for k, pose in zip(index, moved, strict=True)}


def _common(target: Placed, source: Placed, pairs: Mapping[Pair, TwoView]) -> tuple[F64, F64, int]:
    """Places (N, 3) of landmarks in `source` and in `target`; how many images and pairs link."""
    found = [
        np.stack([source.landmark[k], target.landmark[k]], axis=1)
        for k in source.wTc.keys() & target.wTc.keys()
    ]
    for (i, j), view in pairs.items():
        for one, other, matches in ((i, j, view.matches), (j, i, view.matches[:, ::-1])):
            if one in source.wTc and other in target.wTc:
                ends = source.landmark[one][matches[:, 0]], target.landmark[other][matches[:, 1]]
                found.append(np.stack(ends, axis=1))
    links = len(found)
    both = np.concatenate([*found, np.empty((0, 2), np.int64)])
    both = np.unique(both[(both >= 0).all(axis=1)], axis=0)
    return source.position[both[:, 0]], target.position[both[:, 1]], links


def _similarity(x: F64, y: F64, within: float, seed: int) -> tuple[Alignment | None, Bools]:
    """The similarity that most agree with, adjusted to them, and which do (N,)."""
    nothing = np.zeros(len(x), dtype=bool)
    if len(x) < _FEWEST:
        return None, nothing
    found = robust_similarity.similarity(x, y, within, seed)
    if found is None:
        return None, nothing
    fits = np.linalg.norm(found.apply(x) - y, axis=1) <= within
    try:
        found = align(x[fits], y[fits], True)
    except GeometryError:
        return None, nothing
    return found, np.linalg.norm(found.apply(x) - y, axis=1) <= within
