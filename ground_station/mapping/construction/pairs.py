"""Which images are compared with which."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.mapping.settings import MatchSettings

F32 = npt.NDArray[np.float32]

_WORDS = 64
_SAMPLE = 40_000
"""Descriptors that the vocabulary is made from."""


def choose_pairs(
    descriptors: Sequence[F32], settings: MatchSettings, seed: int
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of images to match, sorted.

    Up to `exhaustive_max` images all of them; above, each with its `neighbours` followers and with
    the `similar` images nearest by `vlad`.
    """
    n = len(descriptors)
    if n <= settings.exhaustive_max:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    near = settings.neighbours
    pairs = {(i, j) for i in range(n) for j in range(i + 1, min(i + 1 + near, n))}
    if settings.similar:
        images = vlad(descriptors, seed)
        similarity = images @ images.T
        index = np.arange(n)
        similarity[np.abs(index[:, None] - index) <= near] = -np.inf
        for i, row in enumerate(np.argsort(-similarity, axis=1)[:, : settings.similar]):
            pairs.update((min(i, int(j)), max(i, int(j))) for j in row if abs(i - j) > near)
    return sorted(pairs)


def vlad(descriptors: Sequence[F32], seed: int) -> F32:
    """One unit vector an image (n, 64·D) from its descriptors (N, D) each.

    Sums of residuals to the nearest visual word, normalised word by word and then as a whole:
    Arandjelović and Zisserman, "All about VLAD", CVPR 2013.
    """
    rng = np.random.default_rng(seed)
    everything = np.concatenate(descriptors)
    chosen = rng.choice(len(everything), min(_SAMPLE, len(everything)), replace=False)
    sample = np.ascontiguousarray(everything[np.sort(chosen)], dtype=np.float32)
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 1e-4)
    labels = np.empty((0, 1), np.int32)
    words = min(_WORDS, len(sample))
    _, _, centres = cv2.kmeans(sample, words, labels, criteria, 1, cv2.KMEANS_PP_CENTERS)
    result = np.zeros((len(descriptors), words, everything.shape[1]), np.float32)
    for image, mine in zip(result, descriptors, strict=True):
        # The nearest word by ‖d − c‖² = 1 + ‖c‖² − 2 d·c
        word = (2 * mine @ centres.T - (centres**2).sum(axis=1)).argmax(axis=1)
        np.add.at(image, word, mine - centres[word])
        image /= np.maximum(np.linalg.norm(image, axis=1, keepdims=True), 1e-12)
    flat = result.reshape(len(descriptors), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12))
