"""The images of a large build as overlapping parts, cut where few matches are lost.

The graph of verified pairs is halved by its normalised cut (Shi and Malik, "Normalized cuts and
image segmentation", PAMI 2000) until no piece is too large. Then each piece takes those images of
every piece beside it that share most with it: what two parts have in common is what they are joined
by. Zhu et al., "Very large-scale global SfM by distributed motion averaging", CVPR 2018,
cut in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

from ground_station.arrays import I64, Bools
from ground_station.mapping.construction.pairs import Pair, symmetric

OVERLAP = 0.1
"""Of the largest part's images, how many a part takes from each part beside it."""
_LEAST_OVERLAP = 8
"""Images; that many, where there are so many to take."""
_BESIDE_PAIRS = 3
"""Pieces with fewer pairs between them are not beside each other."""
_AROUND = 0.15
"""A piece is cut within this share of its images around the place that makes equal parts."""
_SHIFT = 1e-3
"""What makes the Laplacian invertible; its eigenvalues are between 0 and 2."""


@dataclass(frozen=True)
class Part:
    """Images by index, sorted: the `core`, which no other part has as its core, and all `images`.

    A part's images are its core and what it takes from the parts beside it.
    """

    core: I64
    images: I64


def overlapping(pairs: Mapping[Pair, int], images: int, most: int) -> list[Part]:
    """Parts of at most `most` images and what they overlap by, the one with image 0 first.

    `pairs` gives the matches of verified pairs. Images without a pair are in no part.
    """
    weight = _weights(pairs, images)
    cores = [core for core in _pieces(weight, most) if len(core) > 1]
    home = np.full(images, -1, dtype=np.int64)
    for number, core in enumerate(cores):
        home[core] = number
    taken: list[list[I64]] = [[core] for core in cores]
    share = max(_LEAST_OVERLAP, round(OVERLAP * most))
    for one, other in _beside(pairs, home):
        taken[one].append(_nearest(weight, cores[one], cores[other], share))
        taken[other].append(_nearest(weight, cores[other], cores[one], share))
    return [
        Part(core, np.unique(np.concatenate(mine))) for core, mine in zip(cores, taken, strict=True)
    ]


def inside(parts: Sequence[Part], pairs: Iterable[Pair], images: int) -> list[list[Pair]]:
    """The pairs of images that each part has both of, in their order."""
    within = holders((part.images for part in parts), images)
    found: list[list[Pair]] = [[] for _ in parts]
    for i, j in pairs:
        for number in within[i] & within[j]:
            found[number].append((i, j))
    return found


def holders(parts: Iterable[I64], images: int) -> list[set[int]]:
    """Which of the parts, each some images by index, every image is in."""
    found: list[set[int]] = [set() for _ in range(images)]
    for number, part in enumerate(parts):
        for k in part.tolist():
            found[k].add(number)
    return found


def _weights(pairs: Mapping[Pair, int], images: int) -> csr_array:
    """Matches between images, symmetric (images, images)."""
    ends = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
    return symmetric(ends, np.fromiter(pairs.values(), np.float64, len(pairs)), images)


def _pieces(weight: csr_array, most: int) -> list[I64]:
    """Disjoint pieces of at most `most` images, in order of their first image."""
    _, component = connected_components(weight, directed=False)
    order = np.argsort(component, kind="stable")
    waiting = np.split(order, np.flatnonzero(np.diff(component[order])) + 1)
    done: list[I64] = []
    while waiting:
        piece = np.sort(waiting.pop())
        if len(piece) <= most:
            done.append(piece)
            continue
        inside = weight[piece][:, piece]
        left = _halved(inside, most)
        for side in (left, ~left):
            # What a cut leaves in pieces is no part: each goes on by itself.
            _, component = connected_components(inside[side][:, side], directed=False)
            waiting += [piece[side][component == k] for k in range(component.max() + 1)]
    return sorted(done, key=lambda piece: int(piece[0]))


def _halved(weight: csr_array, most: int) -> Bools:
    """Which images (n,) are on one side of the best cut of a connected graph."""
    n = weight.shape[0]
    degree = np.asarray(weight.sum(axis=1), np.float64)
    scaling = diags_array(1.0 / np.sqrt(degree))
    shifted = diags_array(np.full(n, 1.0 + _SHIFT)) - scaling @ weight @ scaling
    start = np.random.default_rng(0).normal(size=n)
    _, vectors = eigsh(shifted.tocsc(), k=2, sigma=0.0, which="LM", v0=start)
    # The first eigenvector is the square root of the degrees; the other one is Fiedler's.
    along = np.abs(vectors.T @ np.sqrt(degree))
    order = np.argsort(vectors[:, int(along.argmin())] / np.sqrt(degree), kind="stable")
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    edges = weight.tocoo()
    ends = np.sort(place[np.stack([edges.row, edges.col])], axis=0)
    # A pair is lost by each cut between the places of its two images.
    lost = np.cumsum(
        np.bincount(ends[0], edges.data, n + 1) - np.bincount(ends[1], edges.data, n + 1)
    )[: n - 1]
    inside = np.cumsum(degree[order])[: n - 1]
    cost = lost / inside + lost / (inside[-1] + degree[order[-1]] - inside)
    parts = -(-n // most)
    share = (parts // 2) / parts
    first = min(max(int((share - _AROUND) * n), 1), n - 1)
    last = min(max(int((share + _AROUND) * n), first + 1), n)
    cut = first - 1 + int(np.argmin(cost[first - 1 : last - 1]))
    return np.asarray(place <= cut)


def _beside(pairs: Mapping[Pair, int], home: I64) -> list[Pair]:
    """Which pieces share pairs, as their numbers (a, b), a < b."""
    ends = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
    pieces = np.sort(home[ends], axis=1)
    pieces = pieces[(pieces[:, 0] >= 0) & (pieces[:, 0] < pieces[:, 1])]
    found, count = np.unique(pieces, axis=0, return_counts=True)
    return [(int(a), int(b)) for a, b in found[count >= _BESIDE_PAIRS]]


def _nearest(weight: csr_array, mine: I64, others: I64, count: int) -> I64:
    """The images of another piece that a piece takes: those that share most, and then theirs.

    In rounds, because what is next to an image that was taken is what the two parts overlap by.
    """
    between = weight[others]
    inside = np.zeros(weight.shape[0])
    inside[mine] = 1.0
    taken = np.zeros(len(others), dtype=bool)
    each = max(1, count // 4)
    while taken.sum() < min(count, len(others)):
        shared = np.where(taken, 0.0, between @ inside)
        new = np.argsort(-shared, kind="stable")[: min(each, count - int(taken.sum()))]
        new = new[shared[new] > 0]
        if not len(new):
            break
        taken[new] = True
        inside[others[new]] = 1.0
    return others[taken]
