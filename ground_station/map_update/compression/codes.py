"""Words for descriptors: product quantisation (Jégou, Douze and Schmid, TPAMI 2011).

A descriptor is cut into stretches of as many numbers, and of each stretch the number of the nearest
of 256 words is kept: a byte a stretch, whatever it held.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError
from ground_station.map.descriptors import CodedDescriptors, Descriptors
from ground_station.progress import Progress

F32 = npt.NDArray[np.float32]

WORDS = 256
_TRAINING = 50_000
"""Descriptors that the words are learned from, at most: 200 a word."""
_ROUNDS = 25
"""Of k-means."""
_ROWS = 1 << 11


def usual_bytes(dimension: int, numbers: int = 4) -> int:
    """Bytes for descriptors of D numbers: one for every four of them, or the next that divides."""
    return next(n for n in range(max(1, dimension // numbers), 0, -1) if dimension % n == 0)


def code(descriptors: F32 | Descriptors, stretches: int, seed: int) -> CodedDescriptors:
    """Descriptors (M, D), M > 0, as a byte for each of so many stretches, with words of their own.

    Raises `MapError` when the stretches do not divide D.
    """
    count, dimension = descriptors.shape
    if not 1 <= stretches <= dimension or dimension % stretches:
        allowed = [n for n in range(1, dimension + 1) if dimension % n == 0]
        raise MapError(
            f"{stretches} bytes a descriptor: of {dimension} numbers, allowed are "
            f"{', '.join(map(str, allowed))}"
        )
    rng = np.random.default_rng(seed)
    training = _stretched(descriptors[rng.permutation(count)[:_TRAINING]], stretches)
    with Progress("words, stretches", stretches) as progress:
        words = []
        for part in training:
            words.append(_k_means(part, min(WORDS, count), rng))
            progress.step()
    # Rounded as they are kept, so that each code is of the word that is nearest in the end.
    codebook = np.array(words).astype(np.float16)
    codes = np.empty((count, stretches), np.uint8)
    for start in range(0, count, _ROWS):
        rows = _stretched(descriptors[start : start + _ROWS], stretches)
        for s, part in enumerate(rows):
            codes[start : start + _ROWS, s] = _nearest(part, codebook[s].astype(np.float32))
    return CodedDescriptors(codes, codebook)


def error(descriptors: F32 | Descriptors, coded: Descriptors) -> float:
    """The RMS distance between descriptors (M, D) and what is kept of them."""
    total = 0.0
    for start in range(0, len(descriptors), _ROWS):
        apart = descriptors[start : start + _ROWS] - coded[start : start + _ROWS]
        total += float(np.vdot(apart, apart))
    return float(np.sqrt(total / max(len(descriptors), 1)))


def _stretched(rows: F32, stretches: int) -> F32:
    """Rows (N, D) by stretch: (stretches, N, D / stretches)."""
    return np.ascontiguousarray(rows.reshape(len(rows), stretches, -1).transpose(1, 0, 2))


def _k_means(rows: F32, count: int, rng: np.random.Generator) -> F32:
    """`count` words (count, d) for rows (N, d), N >= count, by Lloyd's algorithm from k-means++.

    A word that no row is nearest to takes the place of the row that fits worst.
    """
    words = _first_words(rows, count, rng)
    for _ in range(_ROUNDS):
        word = _nearest(rows, words)
        size = np.bincount(word, minlength=count)
        total = np.stack([np.bincount(word, column, count) for column in rows.T], axis=1)
        moved = (total / np.maximum(size, 1)[:, None]).astype(np.float32)
        empty = np.flatnonzero(size == 0)
        if len(empty):
            apart = np.square(rows - moved[word]).sum(axis=1)
            moved[empty] = rows[np.argsort(-apart, kind="stable")[: len(empty)]]
        if np.array_equal(moved, words):
            break
        words = moved
    return words


def _first_words(rows: F32, count: int, rng: np.random.Generator) -> F32:
    """Rows far from each other: Arthur and Vassilvitskii, SODA 2007."""
    chosen = [int(rng.integers(len(rows)))]
    apart = np.square(rows - rows[chosen[0]]).sum(axis=1, dtype=np.float64)
    while len(chosen) < count:
        total = apart.sum()
        if total <= 0:  # all that is left is there already
            chosen += rng.integers(len(rows), size=count - len(chosen)).tolist()
            break
        drawn = int(np.searchsorted(np.cumsum(apart), rng.random() * total, side="right"))
        chosen.append(min(drawn, len(rows) - 1))
        apart = np.minimum(apart, np.square(rows - rows[chosen[-1]]).sum(axis=1, dtype=np.float64))
    return rows[chosen].copy()


def _nearest(rows: F32, words: F32) -> npt.NDArray[np.intp]:
    """The nearest word (W, d) of each row (N, d): (N,)."""
    half = 0.5 * np.vecdot(words, words)
    found = np.empty(len(rows), np.intp)
    for start in range(0, len(rows), _ROWS):
        found[start : start + _ROWS] = (rows[start : start + _ROWS] @ words.T - half).argmax(axis=1)
    return found
