"""Which pairs of frames far apart in time show one place, by a model made of the chain alone.

A model of links only (`chains`) knows no place twice, so it cannot mistake one for another; but it
drifts: when the camera comes back, the same landmark stands there a second time, a little off. A
pair says where its first frame's landmarks should be found again. How far that is from where they
are is drift if the pair is right, and the way to the next door if it is not. Drift grows with the
way, and is nearly the same for two pairs that are beside each other. So pairs are judged from where
the way between their frames is short, and each by its nearest neighbour among those believed: at
the camera's turning point that is the chain itself, which is where it is.

The loops are hypotheses, as in Latif, Cadena and Neira, "Robust loop closing over time", RSS 2012;
what they must agree with is the chain and each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ground_station.arrays import F64, I64, Bools
from ground_station.mapping.construction.pairs import Pair
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.sfm.two_view import TwoView

_DRIFT = 0.05
"""Drift over the way: visual odometry of a calibrated camera has about a hundredth."""
SLACK_DEPTHS = 0.08
"""What a landmark's own error may be, in distances at which landmarks are seen."""
_SPEAKS = 6
"""Landmarks that a pair must show twice, or nothing is known of it."""


def believed(
    models: Sequence[Placed],
    sequence: I64,
    links: set[Pair],
    pairs: Mapping[Pair, TwoView],
) -> set[Pair]:
    """The pairs that are links or agree with them, and all pairs of images without a place.

    `models` are those made of links, none of which is joined to another: a pair between two of them
    is not believed. `sequence` (n,) as `pairs.sequences` gives it.
    """
    home = {k: number for number, model in enumerate(models) for k in model.wTc}
    kept = {pair for pair in pairs if pair in links or not {*pair} <= home.keys()}
    for number, model in enumerate(models):
        loops: list[Pair] = []
        moved: list[F64] = []
        for pair in sorted(pairs.keys() - kept):
            if home[pair[0]] == home[pair[1]] == number:
                by = _moved(model, pair, pairs[pair])
                if by is not None:
                    loops.append(pair)
                    moved.append(by)
        if loops:
            ends, way = np.array(loops), _way(model, sequence)
            slack = SLACK_DEPTHS * model.depth
            agreeing = _agreeing(way[ends], sequence[ends], np.array(moved), slack)
            kept.update(loop for loop, agrees in zip(loops, agreeing, strict=True) if agrees)
    return kept


def _moved(model: Placed, pair: Pair, view: TwoView) -> F64 | None:
    """How far the second image's landmarks stand from the first's that they should be, (3,)."""
    first = model.landmark[pair[0]][view.matches[:, 0]]
    second = model.landmark[pair[1]][view.matches[:, 1]]
    both = (first >= 0) & (second >= 0)
    if np.count_nonzero(both) < _SPEAKS:
        return None
    way = model.position[second[both]] - model.position[first[both]]
    return np.asarray(np.median(way, axis=0), np.float64)


def _way(model: Placed, sequence: I64) -> F64:
    """How far the camera had come at each image (n,), in its sequence; between those placed."""
    way = np.zeros(len(model.landmark))
    for number in np.unique(sequence):
        members = [int(k) for k in np.flatnonzero(sequence == number) if int(k) in model.wTc]
        centres = np.array([model.wTc[k][:3, 3] for k in members]).reshape(-1, 3)
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        way[members] = np.concatenate([[0.0], np.cumsum(steps)])[: len(members)]
    return way


def _agreeing(way: F64, sequence: I64, by: F64, slack: float) -> Bools:
    """Which hypotheses agree with their nearest neighbour among those believed, (H,).

    `way` and `sequence` (H, 2) of the two images, `by` (H, 3). In the beginning the chain is
    believed: an image is where it is. Of different sequences, what agrees with the model as it is.
    """
    same = sequence[:, 0] == sequence[:, 1]
    # The nearest believed hypothesis: the way to it, and its vector.
    near = np.where(same, np.abs(way[:, 1] - way[:, 0]), np.inf)
    vector = np.zeros_like(by)
    across = ~same & (np.linalg.norm(by, axis=1) <= slack)
    near[across] = 0.0
    accepted = np.zeros(len(by), dtype=bool)
    undecided = np.ones(len(by), dtype=bool)
    off = np.linalg.norm(by - vector, axis=1)
    while undecided.any():
        cost = np.where(undecided, _DRIFT * near + off, np.inf)
        k = int(cost.argmin())
        if not np.isfinite(cost[k]):
            break
        undecided[k] = False
        if off[k] > _DRIFT * near[k] + slack:
            continue
        accepted[k] = True
        alike = (sequence == sequence[k]).all(axis=1)
        distance = np.where(alike, np.abs(way - way[k]).sum(axis=1), np.inf)
        closer = undecided & (distance < near)
        near[closer], vector[closer] = distance[closer], by[k]
        off[closer] = np.linalg.norm(by[closer] - by[k], axis=1)
    return accepted


def among(pairs: Mapping[Pair, TwoView], chosen: Iterable[Pair]) -> dict[Pair, TwoView]:
    """Those of the pairs, in their order."""
    wanted = set(chosen)
    return {pair: view for pair, view in pairs.items() if pair in wanted}
