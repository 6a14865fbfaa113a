"""Where a model hangs together by few landmarks, so that one part's scale says little of another's.

Of two sets of images, scale is carried across by landmarks that both triangulate, each by two
observations, by two images of one set that stand each among the other's landmarks, or by one of
each: the step between the two has a length in both. Such a step may be short, so that what the
shared landmarks leave open is asked as well. Where that is too much, a bundle adjustment moves one
set against the other for next to nothing, and they are kept apart; where it is a little, they stay
together, and it is said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree

from ground_station.arrays import I64, Bools
from ground_station.geometry import poses
from ground_station.map.uncertainty import jacobian
from ground_station.mapping.construction.placing.chains import components
from ground_station.mapping.construction.placing.placed import Placed

_FEWEST = 30
"""Landmarks that place one set in another; as many as join two models."""

_MOVES = 0.01
"""Of the depth: what noise leaves open by no more is not worth a word; five of these are a
misplaced image. Where 2 % were left open, a simulated walk's scale was 4 % off."""
_LOOSE = 0.05
"""Of the depth: what hangs by no more stays in the map, with a doubt. Of a real corridor's every
fourth frame and of its half-sized pictures, cut before into halves, 0.7 to 3.7 % were left open,
and kept together they were off by 0.6 to 2.5 % at most."""
_NOISE_PX = 0.5
"""Of a key point: builds of a real kitchen and a real corridor find 0.42 to 0.53."""

_PART = 5
"""Images; fewer do not drift by themselves: with two, a right simulated map lost four of 125."""


@dataclass(frozen=True)
class Hinge:
    """A cut of a model: the `images` of its smaller side, by index, and how far they may be off.

    `deviation`: the largest of an image's place against the other side, over the depth, by noise
    alone; 0 where scale is carried across by more than a step.
    """

    images: frozenset[int]
    deviation: float


def separated(model: Placed) -> list[set[int]]:
    """The model's images, by index, in sets that hang together, the largest first.

    The cuts that are tried are those of a tree of the pairs that share most landmarks, the weakest
    first. A few images are no set: they hang by their poses, which were found among points.
    """
    return _cut(model)[0]


def hinges(model: Placed) -> list[Hinge]:
    """Where what hangs together may still move by more than a step should, the loosest first."""
    found = [hinge for hinge in _cut(model)[1] if _MOVES < hinge.deviation <= _LOOSE]
    return sorted(found, key=lambda hinge: -hinge.deviation)


def doubt(found: Sequence[Hinge], names: Sequence[str]) -> list[str]:
    """A sentence on the loosest of some hinges; none where there are none."""
    if not found:
        return []
    images = sorted(found[0].images)
    also = f"; {len(found) - 1} more such places are less open" if len(found) > 1 else ""
    return [
        f"{len(images)} images, {names[images[0]]} to {names[images[-1]]}, hang on the rest by few "
        f"landmarks: their places may be off by {found[0].deviation:.1%} of the distance at which "
        f"things are seen{also}"
    ]


def _cut(model: Placed) -> tuple[list[set[int]], list[Hinge]]:
    """The sets that hang together, and every cut between two of five images or more."""
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
    found = []
    for n, (i, j) in enumerate(edges.tolist()):
        kept[n] = False
        part = components([edges[kept]], len(index))
        sides = part == part[i], part == part[j]
        smaller = min(sides, key=np.count_nonzero)
        if np.count_nonzero(smaller) < _PART:
            kept[n] = True
            continue
        hinge = Hinge(
            frozenset(index[smaller].tolist()), _left_open(model, index, observations, sides)
        )
        kept[n] = hinge.deviation <= _LOOSE
        found.append(hinge)
    part = components([edges[kept]], len(index))
    sets = [{*index[part == number].tolist()} for number in np.unique(part).tolist()]
    return sorted(sets, key=lambda each: -len(each)), found


def _left_open(
    model: Placed, index: I64, observations: csr_array, sides: tuple[Bools, Bools]
) -> float:
    """How far one set of images may move against the other, as `Hinge` has it."""
    one, other = (observations[side] for side in sides)
    first, second = (
        np.bincount(each.indices, minlength=each.shape[1]) >= 2 for each in (one, other)
    )
    if np.count_nonzero(first & second) >= _FEWEST:
        return 0.0
    if max(_stand_among(one, second), _stand_among(other, first)) >= 2:
        return 0.0
    return _deviation(model, *(index[side] for side in sides))


def _deviation(model: Placed, one: I64, other: I64) -> float:
    """How far the images `other` may move against `one`, each set rigid, over the depth.

    The largest standard deviation of an image's place under a similarity of the whole set, from
    the pixels of the landmarks that both see, these marginalised.
    """
    centres = np.array([model.wTc[k][:3, 3] for k in other.tolist()])
    middle, M = centres.mean(axis=0), len(model.position)
    focal = model.pinhole[:2]
    of_point = np.zeros((M, 3, 3))
    of_both, of_set = np.zeros((M, 7, 3)), np.zeros((M, 7, 7))
    for k in [*one.tolist(), *other.tolist()]:
        seen = np.unique(model.landmark[k][model.landmark[k] >= 0])
        cTw = poses.inverse(model.wTc[k])
        local = poses.transform(cTw, model.position[seen])
        seen, local = seen[local[:, 2] > 0], local[local[:, 2] > 0]
        by_point = np.zeros((len(seen), 2, 3))
        for axis in (0, 1):
            by_point[:, axis, axis] = focal[axis] / local[:, 2]
            by_point[:, axis, 2] = -focal[axis] * local[:, axis] / local[:, 2] ** 2
        by_point = by_point @ cTw[:3, :3] / _NOISE_PX
        of_point[seen] += np.swapaxes(by_point, 1, 2) @ by_point
        if k in other:  # whoever moves sees a landmark as if it had moved the other way
            by_set = -by_point @ jacobian(model.position[seen] - middle)
            of_both[seen] += np.swapaxes(by_set, 1, 2) @ by_point
            of_set[seen] += np.swapaxes(by_set, 1, 2) @ by_set
    left = of_set - of_both @ np.linalg.pinv(of_point, hermitian=True) @ np.swapaxes(of_both, 1, 2)
    try:  # an open scale's eigenvalue is 0 but for rounding, of either sign
        root = np.linalg.inv(np.linalg.cholesky(left.sum(axis=0)))
    except np.linalg.LinAlgError:
        return float("inf")
    variance = np.square(jacobian(centres - middle) @ root.T).sum(axis=(1, 2))
    return float(np.sqrt(variance.max())) / model.depth


def _stand_among(images: csr_array, triangulated: Bools) -> int:
    """How many images see as many of the landmarks as place one."""
    return int(np.count_nonzero(images @ triangulated.astype(float) >= _FEWEST))
