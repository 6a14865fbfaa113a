"""Which images are compared with which."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import scipy.linalg
from scipy.sparse import csr_array

from ground_station.arrays import F32, F64, I64
from ground_station.mapping.settings import MatchSettings

Pair = tuple[int, int]

_WORDS = 64
_SAMPLE = 40_000
"""Descriptors that the vocabulary is made from."""
_COMPARED_WHOLE = 2048
"""Images; so many vectors are compared each with each, of more an index finds the near ones."""
_DIMENSIONS, _LEARNED_FROM = 256, 2048
_RANDOM_TREES, _TREES, _CHECKS = 1, 8, 1024
"""FLANN's randomised k-d trees (Muja and Lowe, PAMI 2014). Of 10,000 vectors of 256 numbers along a
way that is gone twice they find 96 % of the 40 nearest, in time that grows with the images; four
trees and 256 checks find 76 %."""


def sequences(names: Sequence[str], time_ns: I64) -> I64:
    """Which way of a camera each image belongs to, (n,), counted from 0.

    Another begins where the input's name before the last `/` changes, or where time falls back: the
    image before is no neighbour then.
    """
    inputs = [name.rpartition("/")[0] for name in names]
    another = np.array([a != b for a, b in itertools.pairwise(inputs)], dtype=bool)
    return np.concatenate([[0], np.cumsum(another | (np.diff(time_ns) < 0))]).astype(np.int64)


def is_exhaustive(images: int, settings: MatchSettings) -> bool:
    """Whether every pair of so many images is compared."""
    return settings.pairs == "exhaustive" or images <= settings.exhaustive_max


def choose_pairs(
    descriptors: Sequence[F32],
    settings: MatchSettings,
    seed: int,
    sequence: I64 | None = None,
) -> list[Pair]:
    """Pairs (i, j), i < j, of images to match, sorted.

    All of them where the settings say so, and up to `exhaustive_max` images. Otherwise each image
    with `steps` of up to `neighbours` images ahead in the same of `sequences` (all one by default),
    and with the `similar` images nearest by `vlad` that are no neighbours.
    """
    n = len(descriptors)
    if is_exhaustive(n, settings):
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    way = np.zeros(n, dtype=np.int64) if sequence is None else sequence
    ends = [_ahead(way, step) for step in steps(settings.neighbours)]
    if settings.similar:
        ends.append(_similar(descriptors, settings, seed, way))
    return _listed(np.concatenate(ends), n)


def steps(reach: int) -> list[int]:
    """How far ahead an image is compared: 1, 2, 3, 4, 6, 8, 12, 16, 24 … up to `reach` images.

    What lies between two of them shows little that they do not; where it does, it is `covisible`.
    """
    doubled = (base << k for k in range(reach.bit_length()) for base in (2, 3))
    return [1, *sorted(step for step in doubled if step <= reach)]


def covisible_pairs(
    images: int, tried: Sequence[Pair], linked: Mapping[Pair, int], settings: MatchSettings
) -> list[Pair]:
    """Pairs (i, j), i < j, that were not `tried` and of which a third image has seen both, sorted.

    `linked` gives the verified matches of pairs; a link is strong with `min_inliers_far` of them.
    Two images are as near as the sum, over the images strongly linked to both, of the weaker link;
    each image takes its `covisible` nearest. (Mur-Artal, Montiel and Tardós, "ORB-SLAM", T-RO 2015,
    section III.D, take shared landmarks where we have matches only.)
    """
    ends = np.array(list(linked), dtype=np.int64).reshape(-1, 2)
    matches = np.fromiter(linked.values(), np.int64, len(linked))
    strong = matches >= settings.min_inliers_far
    weight = symmetric(ends[strong], matches[strong], images)
    known = symmetric(np.array(tried, dtype=np.int64).reshape(-1, 2), None, images)
    found = []
    for i in range(images):
        between, first = _row(weight, i)
        if not len(between):
            continue
        rows = [_row(weight, int(k)) for k in between]
        reached = np.concatenate([columns for columns, _ in rows])
        weaker = np.concatenate(
            [np.minimum(w, values) for w, (_, values) in zip(first, rows, strict=True)]
        )
        image, place = np.unique(reached, return_inverse=True)
        shared = np.bincount(place, weaker)
        new = ~np.isin(image, _row(known, i)[0]) & (image != i)
        image, shared = image[new], shared[new]
        nearest = image[np.argsort(-shared, kind="stable")[: settings.covisible]]
        found.append(np.stack([np.full(len(nearest), i), nearest], axis=1))
    return _listed(np.concatenate([*found, np.empty((0, 2), np.int64)]), images)


def vlad(descriptors: Sequence[F32], seed: int) -> F32:
    """One unit vector an image (n, 64·D) from its descriptors (N, D) each.

    Sums of residuals to the nearest visual word, normalised word by word and then as a whole:
    Arandjelović and Zisserman, "All about VLAD", CVPR 2013. Of an image without features, zeros.
    """
    words = _vocabulary(descriptors, seed)
    return np.stack([_vlad_of(mine, words) for mine in descriptors])


def reduced_vlad(descriptors: Sequence[F32], seed: int) -> F32:
    """`vlad` in its strongest dimensions (n, at most 256), unit vectors; one image at a time.

    Principal components of some of the images, evenly chosen: Jégou, Douze, Schmid and Pérez,
    "Aggregating local descriptors into a compact image representation", CVPR 2010, section 4.
    """
    n, words = len(descriptors), _vocabulary(descriptors, seed)
    some = np.unique(np.linspace(0, n - 1, min(n, _LEARNED_FROM)).astype(np.int64))
    learned = np.stack([_vlad_of(descriptors[k], words) for k in some.tolist()])
    mean = learned.mean(axis=0)
    learned -= mean
    most = min(_DIMENSIONS, len(learned))
    # Of fewer images than dimensions, the small side's eigenvectors give those of the large one.
    last = len(learned) - 1
    _, vectors = scipy.linalg.eigh(
        learned @ learned.T, subset_by_index=(last - most + 1, last), driver="evr"
    )
    basis = learned.T @ vectors.astype(np.float32)
    basis /= np.maximum(np.linalg.norm(basis, axis=0), 1e-12)
    result = np.stack([(_vlad_of(mine, words) - mean) @ basis for mine in descriptors])
    return np.asarray(result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12))


def _vocabulary(descriptors: Sequence[F32], seed: int) -> F32:
    """Visual words (64, D), from a sample of all descriptors; fewer where there are fewer."""
    rng = np.random.default_rng(seed)
    offset = np.cumsum([0, *map(len, descriptors)])
    if not offset[-1]:
        return np.zeros((1, 1), np.float32)
    chosen = np.sort(rng.choice(offset[-1], min(_SAMPLE, int(offset[-1])), replace=False))
    starts = np.searchsorted(chosen, offset)
    sample = np.concatenate(
        [
            descriptors[k][chosen[first:last] - offset[k]]
            for k, (first, last) in enumerate(itertools.pairwise(starts.tolist()))
            if last > first
        ]
    )
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 1e-4)
    labels = np.empty((0, 1), np.int32)
    words = min(_WORDS, len(sample))
    _, _, centres = cv2.kmeans(sample, words, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.asarray(centres, np.float32)


def _vlad_of(mine: F32, words: F32) -> F32:
    """One image's vector (words · D)."""
    result = np.zeros(words.shape, np.float32)
    if len(mine):
        # The nearest word by ‖d − c‖² = 1 + ‖c‖² − 2 d·c
        word = (2 * mine @ words.T - (words**2).sum(axis=1)).argmax(axis=1)
        np.add.at(result, word, mine - words[word])
    result /= np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)
    flat = result.reshape(1, -1)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    return np.asarray(flat[0])


def _similar(descriptors: Sequence[F32], settings: MatchSettings, seed: int, way: I64) -> I64:
    """Each image with the most similar ones that are no neighbours of it, as pairs (P, 2)."""
    n = len(descriptors)
    if n <= _COMPARED_WHOLE:
        images = vlad(descriptors, seed)
        similarity = images @ images.T
        np.fill_diagonal(similarity, -np.inf)
        for step in range(1, settings.neighbours + 1):
            i, j = _ahead(way, step).T
            similarity[i, j] = similarity[j, i] = -np.inf
        nearest = np.argsort(-similarity, axis=1)[:, : settings.similar]
        other = np.take_along_axis(similarity, nearest, axis=1) > -np.inf
    else:
        images = reduced_vlad(descriptors, seed)
        # Of an image's nearest, its neighbours may be all but the last.
        wanted = min(settings.similar + 2 * settings.neighbours + 1, n)
        cv2.setRNGSeed(seed)
        index = cv2.flann.Index(images, {"algorithm": _RANDOM_TREES, "trees": _TREES})
        found, _ = index.knnSearch(images, wanted, params={"checks": _CHECKS})
        nearest = np.asarray(found, np.int64)
        beside = np.abs(nearest - np.arange(n)[:, None]) <= settings.neighbours
        other = ~(beside & (way[nearest] == way[:, None]))
        other &= np.cumsum(other, axis=1) <= settings.similar
    rows = np.broadcast_to(np.arange(n)[:, None], nearest.shape)
    return np.stack([rows[other], nearest[other]], axis=1).astype(np.int64)


def _ahead(way: I64, step: int) -> I64:
    """Pairs (P, 2) of each image with the one so many further on its way."""
    first = np.flatnonzero(way[:-step] == way[step:])
    return np.stack([first, first + step], axis=1)


def symmetric(pairs: I64, values: I64 | F64 | None, images: int) -> csr_array:
    """A sparse matrix (images, images) with the values of pairs (P, 2) both ways, ones by default.

    Columns are sorted in each row.
    """
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    both = np.ones(len(rows), np.int64) if values is None else np.tile(values, 2)
    result = csr_array((both, (rows, columns)), shape=(images, images))
    result.sort_indices()
    return result


def _row(matrix: csr_array, i: int) -> tuple[I64, I64]:
    """The columns of a row and their values."""
    within = slice(matrix.indptr[i], matrix.indptr[i + 1])
    return matrix.indices[within], matrix.data[within]


def _listed(pairs: I64, images: int) -> list[Pair]:
    """Pairs (P, 2) in either order, some of them twice, as sorted ones (i, j), i < j."""
    key = np.unique(pairs.min(axis=1) * images + pairs.max(axis=1))
    return list(zip((key // images).tolist(), (key % images).tolist(), strict=True))
