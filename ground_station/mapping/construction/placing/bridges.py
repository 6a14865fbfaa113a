"""Where a model hangs together by few landmarks, so that one part's scale says little of another's.

Of two sets of images, scale is carried across by landmarks that both triangulate, each by two
observations, or by two images of one set that stand each among the other's landmarks. Where there
are too few, a bundle adjustment moves one set against the other for next to nothing."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from ground_station.arrays import I32, Bools
from ground_station.mapping.construction.placing.placed import Placed

_FEWEST = 30
"""Landmarks that place one set in another; as many as join two models."""

_PART = 5
"""Images; fewer do not drift by themselves: with two, a right simulated map lost four of 125."""


def separated(model: Placed) -> list[set[int]]:
    """The model's images, by index, in sets that hang together, the largest first.

    The cuts that are tried are those of a tree of the pairs that share most landmarks, the weakest
    first. A few images are no set: they hang by their poses, which were found among points.
    """
    index = np.array(sorted(model.wTc), dtype=np.int64)
    seen = [model.landmark[k][model.landmark[k] >= 0] for k in index.tolist()]
    rows = np.repeat(np.arange(len(index)), [len(each) for each in seen])
    shape = len(index), len(model.position)
    observations = csr_array((np.ones(len(rows)), (rows, np.concatenate(seen))), shape=shape)
    observations.data[:] = 1.0
    shared = csr_array(np.triu((observations @ observations.T).toarray(), 1))
    # The tree of least weight has the largest counts when these are subtracted from a larger one.
    weight = csr_array(shared)
    weight.data = shared.data.max(initial=0.0) + 1.0 - shared.data
    tree = minimum_spanning_tree(weight).tocoo()
    edges = np.stack([tree.row, tree.col], axis=1)[np.argsort(-tree.data, kind="stable")]
    kept = np.ones(len(edges), dtype=bool)
    for n, (i, j) in enumerate(edges.tolist()):
        kept[n] = False
        part = _components(edges[kept], len(index))
        sides = part == part[i], part == part[j]
        few = min(int(np.count_nonzero(side)) for side in sides) < _PART
        kept[n] = few or _carries(observations[sides[0]], observations[sides[1]])
    part = _components(edges[kept], len(index))
    sets = [{*index[part == number].tolist()} for number in np.unique(part).tolist()]
    return sorted(sets, key=lambda each: -len(each))


def _carries(one: csr_array, other: csr_array) -> bool:
    """Whether two sets of images have a scale in common."""
    first, second = (
        np.bincount(each.indices, minlength=each.shape[1]) >= 2 for each in (one, other)
    )
    if np.count_nonzero(first & second) >= _FEWEST:
        return True
    return max(_stand_among(one, second), _stand_among(other, first)) >= 2


def _stand_among(images: csr_array, triangulated: Bools) -> int:
    """How many images see as many of the landmarks as place one."""
    return int(np.count_nonzero(images @ triangulated.astype(float) >= _FEWEST))


def _components(edges: I32, nodes: int) -> I32:
    graph = csr_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1])
