"""Which images are compared with which."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.mapping.settings import MatchSettings

F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
Pair = tuple[int, int]

_WORDS = 64
_SAMPLE = 40_000
"""Descriptors that the vocabulary is made from."""


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
    index = np.arange(n)
    way = np.zeros(n, dtype=np.int64) if sequence is None else sequence
    following = index[None, :] - index[:, None]
    neighbours = (np.abs(following) <= settings.neighbours) & (way[:, None] == way)
    chosen = neighbours & np.isin(following, steps(settings.neighbours))
    if settings.similar:
        images = vlad(descriptors, seed)
        similarity = images @ images.T
        similarity[neighbours] = -np.inf  # an image itself, too
        nearest = np.argsort(-similarity, axis=1)[:, : settings.similar]
        rows = np.repeat(index, nearest.shape[1])
        chosen |= _upper(rows, nearest.ravel(), n) & ~neighbours
    return _listed(chosen)


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
    weight = np.zeros((images, images), dtype=np.int32)
    known = np.eye(images, dtype=bool)
    for i, j in tried:
        known[i, j] = known[j, i] = True
    for (i, j), matches in linked.items():
        if matches >= settings.min_inliers_far:
            weight[i, j] = weight[j, i] = matches
    rows, columns = [], []
    for i, row in enumerate(weight):
        between = np.flatnonzero(row)
        shared = np.minimum(row[between, None], weight[between]).sum(axis=0, dtype=np.int64)
        shared[known[i]] = 0
        nearest = np.argsort(-shared, kind="stable")[: settings.covisible]
        nearest = nearest[shared[nearest] > 0]
        rows.append(np.full(len(nearest), i))
        columns.append(nearest)
    return _listed(_upper(np.concatenate(rows), np.concatenate(columns), images))


def vlad(descriptors: Sequence[F32], seed: int) -> F32:
    """One unit vector an image (n, 64·D) from its descriptors (N, D) each.

    Sums of residuals to the nearest visual word, normalised word by word and then as a whole:
    Arandjelović and Zisserman, "All about VLAD", CVPR 2013. Of an image without features, zeros.
    """
    rng = np.random.default_rng(seed)
    offset = np.cumsum([0, *map(len, descriptors)])
    if not offset[-1]:
        return np.zeros((len(descriptors), 1), np.float32)
    chosen = np.sort(rng.choice(offset[-1], min(_SAMPLE, int(offset[-1])), replace=False))
    image_of = np.searchsorted(offset, chosen, side="right") - 1
    rows = (chosen - offset[image_of]).tolist()
    sample = np.array(
        [descriptors[k][row] for k, row in zip(image_of.tolist(), rows, strict=True)], np.float32
    )
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 1e-4)
    labels = np.empty((0, 1), np.int32)
    words = min(_WORDS, len(sample))
    _, _, centres = cv2.kmeans(sample, words, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    result = np.zeros((len(descriptors), words, sample.shape[1]), np.float32)
    for image, mine in zip(result, descriptors, strict=True):
        # The nearest word by ‖d − c‖² = 1 + ‖c‖² − 2 d·c
        word = (2 * mine @ centres.T - (centres**2).sum(axis=1)).argmax(axis=1)
        np.add.at(image, word, mine - centres[word])
        image /= np.maximum(np.linalg.norm(image, axis=1, keepdims=True), 1e-12)
    flat = result.reshape(len(descriptors), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12))


def _upper(i: I64, j: I64, images: int) -> npt.NDArray[np.bool_]:
    """Pairs of images as a matrix, each in its upper half, (images, images)."""
    result = np.zeros((images, images), dtype=bool)
    result[np.minimum(i, j), np.maximum(i, j)] = True
    return result


def _listed(chosen: npt.NDArray[np.bool_]) -> list[Pair]:
    return [(int(i), int(j)) for i, j in np.argwhere(chosen)]
