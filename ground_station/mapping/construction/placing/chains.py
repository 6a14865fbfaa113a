"""The way of the camera: which pairs of frames are links that the frames between them confirm.

In a video a frame's place is known best from the frames beside it: they show nearly the same. Two
frames further apart in time may show two places that only look alike. So a pair is a *link* of the
chain when the frames between its two confirm it: their matches lead from the one's key points to
the other's, to the same ones that were matched directly. Between two equal doors, the key points of
the first are lost on the way before the second comes into view.

Images in no order have no chain; nothing that is judged by it says anything about them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ground_station.mapping.construction.matching import TwoView
from ground_station.mapping.construction.pairs import Pair

I64 = npt.NDArray[np.int64]

REACH = 12
"""Frames; a link spans at most so many steps."""
_BRIDGE = 4
"""Frames; where the chain is broken, as by a blurred frame, so short a step needs no witness."""
_CONFIRMED = 0.2
"""Share of a link's matches that the frames between must confirm: most often it is more than half,
between places that look alike nearly none."""
_BESIDE = 0.5
"""Share of frames whose best partner stands beside them, for images to be in order."""
_FEWEST = 8
"""Fewer images have no order that one could tell."""


def in_order(sequence: I64, pairs: Mapping[Pair, TwoView]) -> npt.NDArray[np.bool_]:
    """Which images are in an order that means something, (n,): a whole sequence is or is not.

    In a video the image that an image has most matches with stands right beside it. In a folder of
    pictures it stands anywhere.
    """
    n = len(sequence)
    most, partner = np.zeros(n, dtype=np.int64), np.full(n, -1)
    for (i, j), view in pairs.items():
        for one, other in ((i, j), (j, i)):
            if len(view.matches) > most[one]:
                most[one], partner[one] = len(view.matches), other
    ordered = np.zeros(n, dtype=bool)
    for number in np.unique(sequence):
        members = np.flatnonzero(sequence == number)
        known = members[partner[members] >= 0]
        if len(known) < _FEWEST:
            continue
        near = min(5, max(1, len(members) // 10))
        beside = (np.abs(partner[known] - known) <= near) & (sequence[partner[known]] == number)
        ordered[members] = beside.mean() >= _BESIDE
    return ordered


def links(
    features: Sequence[int], sequence: I64, ordered: npt.NDArray[np.bool_],
    pairs: Mapping[Pair, TwoView],
) -> set[Pair]:  # fmt: skip
    """The pairs that are links of a chain; `features` is the number of key points of each image.

    From the shortest steps to the longest, each is judged by the tracks that the shorter ones make.
    """
    offset = np.concatenate([[0], np.cumsum(features)]).astype(np.int64)
    found: set[Pair] = set()
    edges: list[I64] = []
    image_edges: list[Pair] = []
    for step in range(1, REACH + 1):
        track = components(edges, int(offset[-1]))
        chained = components([np.array(image_edges, np.int64).reshape(-1, 2)], len(sequence))
        new: list[Pair] = []
        for i in range(len(sequence) - step):
            j = i + step
            view = pairs.get((i, j))
            if view is None or not ordered[i] or sequence[i] != sequence[j]:
                continue
            ends = view.matches + offset[[i, j]]
            confirmed = float(np.mean(track[ends[:, 0]] == track[ends[:, 1]]))
            bridges = step <= _BRIDGE and chained[i] != chained[j]
            if step == 1 or bridges or confirmed >= _CONFIRMED:
                new.append((i, j))
                edges.append(ends)
        found.update(new)
        image_edges += new
    return found


def components(edges: Sequence[I64], nodes: int) -> npt.NDArray[np.int32]:
    """The connected component (nodes,) of each node of a graph; `edges` (E, 2) each."""
    ends = np.concatenate([*edges, np.empty((0, 2), np.int64)])
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1])
