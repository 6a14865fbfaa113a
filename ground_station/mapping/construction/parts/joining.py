"""Where each part is: similarities from images that two parts have in common, all in agreement.

A part knows its own scale and place only. Between two parts, the landmarks of their common images
say the similarity that takes one to the other; around a loop of parts these contradict each other a
little. So all of them together are adjusted as a graph of similarities, as Strasdat, Montiel and
Davison, "Scale drift-aware large scale monocular SLAM", RSS 2010, close loops of key frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from ground_station.arrays import I64
from ground_station.geometry import poses
from ground_station.geometry.alignment import Alignment
from ground_station.mapping.construction.parts.solving import Solved
from ground_station.mapping.construction.placing import merging
from ground_station.mapping.construction.placing.placed import Placed

_FEWEST = 3
"""Common images; with fewer, two parts are not joined."""
_SIGMAS = (0.005, 0.01, 0.01)
"""Of a junction: rotation in radians, place in distances at which landmarks are seen, scale. Their
ratios matter, and from where on a junction that contradicts others counts for less."""
_CAUCHY = 5.0
"""In sigmas. A loop that drifted by ten is closed by a sigma at each of ten junctions; one that is
off by hundreds is a mistake, and stays open."""
_TURNED_DEG, _MOVED_DEPTHS = 5.0, 0.5
"""A junction that ends further than this from where the parts are is not believed."""


_ROUNDS = 3
"""How often junctions that are not believed are left out and the others adjusted again."""


@dataclass(frozen=True)
class Edge:
    """`similarity` takes coordinates of part `source` to those of part `target`.

    `common` images say so.
    """

    target: int
    source: int
    similarity: Alignment
    common: int


def join(parts: Sequence[Solved], seed: int) -> tuple[list[Alignment | None], list[str]]:
    """Joins parts to the largest set that holds together; its largest part gives the scale.

    The similarity from each part's coordinates to common ones, None for those that stay out, and
    notes on these and on junctions that are not believed.
    """
    if len(parts) == 1:
        return [_identity()], []
    edges, doubtful = _edges(parts, seed)
    depth = [_depth(part) for part in parts]
    found: list[Alignment | None] = []
    for _ in range(_ROUNDS):
        found = _spanned(parts, edges)
        edges = [edge for edge in edges if found[edge.target] and found[edge.source]]
        found = _adjusted(found, edges, depth)
        wrong = [edge for edge in edges if not _agrees(edge, found, depth)]
        if not wrong:
            break
        edges = [edge for edge in edges if edge not in wrong]
        doubtful += [f"{_named(edge)}: other parts contradict it" for edge in wrong]
    apart = sum(len(part.index) for part, at in zip(parts, found, strict=True) if at is None)
    notes = [f"junction of {line}: not used" for line in doubtful]
    if apart:
        notes.append(f"{apart} images are in parts that join no other")
    return found, notes


def _named(edge: Edge) -> str:
    return f"parts {edge.target} and {edge.source} over {edge.common} images"


def _edges(parts: Sequence[Solved], seed: int) -> tuple[list[Edge], list[str]]:
    """Junctions of all pairs of parts with enough images in common; what speaks against others."""
    edges, doubtful = [], []
    for one, other in itertools.combinations(range(len(parts)), 2):
        images = np.intersect1d(parts[one].index, parts[other].index)
        if len(images) < _FEWEST:
            continue
        width = 1 + max(int(parts[n].feature.max(initial=0)) for n in (one, other))
        target, source = (_among(parts[n], images, width) for n in (one, other))
        found = merging.junction(target, source, {}, seed)
        if found.similarity is None:
            doubtful.append(f"parts {one} and {other} over {len(images)} images: {found.missing}")
        else:
            edges.append(Edge(one, other, found.similarity, len(images)))
    return edges, doubtful


def _among(part: Solved, images: I64, width: int) -> Placed:
    """A part's landmarks as those images see them, which count from 0 here."""
    rows = np.searchsorted(part.index, images)
    place = np.full(len(part.index), -1, dtype=np.int64)
    place[rows] = np.arange(len(rows))
    seen = np.flatnonzero(place[part.image] >= 0)
    landmark = np.full((len(images), width), -1, dtype=np.int64)
    landmark[place[part.image[seen]], part.feature[seen]] = part.point[seen]
    wTc = {n: part.wTc[row] for n, row in enumerate(rows.tolist())}
    return Placed(list(landmark), wTc, part.position, part.pinhole)


def _depth(part: Solved) -> float:
    rays = part.position[part.point] - part.wTc[part.image, :3, 3]
    return float(np.median(np.linalg.norm(rays, axis=1))) if len(rays) else 1.0


def _identity() -> Alignment:
    return Alignment(np.eye(3), np.zeros(3), 1.0)


def _after(first: Alignment, second: Alignment) -> Alignment:
    """The similarity that applies `first` to what `second` gives."""
    return Alignment(
        first.rotation @ second.rotation,
        first.apply(second.translation[None])[0],
        first.scale * second.scale,
    )


def _inverse(of: Alignment) -> Alignment:
    rotation = of.rotation.T
    return Alignment(rotation, -rotation @ of.translation / of.scale, 1.0 / of.scale)


def _spanned(parts: Sequence[Solved], edges: Sequence[Edge]) -> list[Alignment | None]:
    """Places by a spanning tree of the strongest junctions, of the set with the most images."""
    tree: dict[int, list[tuple[int, Alignment]]] = {n: [] for n in range(len(parts))}
    home = list(range(len(parts)))
    for edge in sorted(edges, key=lambda edge: -edge.common):
        one, other = home[edge.target], home[edge.source]
        if one != other:
            home = [one if at == other else at for at in home]
            tree[edge.target].append((edge.source, edge.similarity))
            tree[edge.source].append((edge.target, _inverse(edge.similarity)))
    size = dict.fromkeys(home, 0)
    for at, part in zip(home, parts, strict=True):
        size[at] += len(part.index)
    largest = max(size, key=lambda at: size[at])
    members = [n for n, at in enumerate(home) if at == largest]
    root = max(members, key=lambda n: len(parts[n].index))
    found: list[Alignment | None] = [None] * len(parts)
    found[root] = _identity()
    waiting = [root]
    while waiting:
        number = waiting.pop()
        here = found[number]
        assert here is not None
        for other, similarity in tree[number]:
            if found[other] is None:
                found[other] = _after(here, similarity)
                waiting.append(other)
    return found


def _similarity3(of: Alignment, unit: float, target: float = 1.0) -> gtsam.Similarity3:
    """In GTSAM's form, s (R x + t), of a part's coordinates in units of what it sees.

    What it gives is in such units of a `target`, another part.
    """
    return gtsam.Similarity3(
        gtsam.Rot3(of.rotation), of.translation / of.scale / unit, of.scale * unit / target
    )


def _alignment(of: gtsam.Similarity3, unit: float) -> Alignment:
    scale = of.scale() / unit
    return Alignment(of.rotation().matrix(), of.scale() * of.translation(), scale)


def _adjusted(
    start: Sequence[Alignment | None], edges: Sequence[Edge], depth: Sequence[float]
) -> list[Alignment | None]:
    """The places that all junctions together agree with best; the first stays where it is."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    placed = [n for n, at in enumerate(start) if at is not None]
    for n in placed:
        at = start[n]
        assert at is not None
        values.insert(n, _similarity3(at, depth[n]))
    rotation, place, scale = _SIGMAS
    sigmas = np.array([rotation] * 3 + [place] * 3 + [scale])
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    )
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)
    graph.add(gtsam.PriorFactorSimilarity3(placed[0], values.atSimilarity3(placed[0]), fixed))
    for edge in edges:
        measured = _similarity3(edge.similarity, depth[edge.source], depth[edge.target])
        graph.add(gtsam.BetweenFactorSimilarity3(edge.target, edge.source, measured, noise))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    result: list[Alignment | None] = [None] * len(start)
    for n in placed:
        result[n] = _alignment(best.atSimilarity3(n), depth[n])
    return result


def _agrees(edge: Edge, at: Sequence[Alignment | None], depth: Sequence[float]) -> bool:
    """Whether a junction is where the parts are."""
    target, source = at[edge.target], at[edge.source]
    assert target is not None and source is not None
    found = _after(_inverse(target), source)
    turned = np.degrees(poses.rotation_angle(found.rotation.T @ edge.similarity.rotation))
    moved = np.linalg.norm(found.translation - edge.similarity.translation) / depth[edge.target]
    return bool(turned <= _TURNED_DEG and moved <= _MOVED_DEPTHS)
