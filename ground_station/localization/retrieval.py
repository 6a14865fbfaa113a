"""Which keyframes of a map look like a frame: each feature votes for where it was seen before.

Features are compared with the landmarks of a few visual words only (Sivic and Zisserman, "Video
Google", ICCV 2003; the search from features to landmarks as in Sattler, Leibe and Kobbelt, ICCV
2011), and a feature's nearest landmark votes for the keyframes that observed it. The words alone,
compared by tf-idf, rank much worse where light and textures change what a building's walls share.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from ground_station.arrays import F32, Indices
from ground_station.map.descriptors import Descriptors, joined
from ground_station.map.modes import Modes
from ground_station.map.store import Keyframes, Landmarks

_WORDS_PER_ROOT, _MAX_WORDS = 1.5, 2048
"""Words grow with the root of the landmarks: finding a word and searching it then cost alike."""
_TRAINING = 30_000
"""Landmarks that the words are learned from, at most."""
_ROUNDS = 8
"""Of k-means: later ones hardly move a word."""
_SEARCHED = 8
"""Words that are searched for a feature: noise moves descriptors over their borders."""
_MAX_RATIO = 0.92
"""A vote needs a nearest landmark that is nearer than the second by this, of L2 distances,"""
_SAME_DISTANCE = 0.45
"""or two that are as near as the same thing seen again."""
_BLOCK = 4_000_000
"""Products held at once: 16 MB."""


def nearest_words(descriptors: F32 | Descriptors, words: F32, count: int = 1) -> Indices:
    """The `count` words (W, D) of largest product with each unit descriptor (N, D): (N, count)."""
    found = np.empty((len(descriptors), count), np.intp)
    rows = max(1, _BLOCK // len(words))
    for start in range(0, len(descriptors), rows):
        cosine = descriptors[start : start + rows] @ words.T
        if count == 1:
            found[start : start + rows, 0] = cosine.argmax(axis=1)
        else:
            found[start : start + rows] = np.argpartition(-cosine, count - 1, axis=1)[:, :count]
    return found


def learn_words(descriptors: F32 | Descriptors, seed: int) -> F32:
    """Words (W, D), unit rows, from unit descriptors (N, D), N > 0: spherical k-means."""
    rng = np.random.default_rng(seed)
    count = int(np.clip(_WORDS_PER_ROOT * np.sqrt(len(descriptors)), 1, _MAX_WORDS))
    training = descriptors[rng.permutation(len(descriptors))[:_TRAINING]]
    words = training[:count].copy()
    for _ in range(_ROUNDS):
        word = nearest_words(training, words)[:, 0]
        member = sparse.csr_matrix(
            (np.ones(len(word), np.float32), (word, np.arange(len(word)))),
            shape=(len(words), len(word)),
        )
        total = np.asarray(member @ training, np.float32)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        words = np.where(length > 1e-6, total / np.maximum(length, 1e-6), words)
    return words


class PlaceIndex:
    """A map's landmarks by visual word and its keyframes by landmark; built once for a map.

    The cost of a query grows with the root of the landmarks until there are two million, beyond
    with a two-hundredth of them. Holds a copy of the descriptors in the order of their words,
    quantised as they are. A landmark's modes lie by their own words and speak for it.
    """

    def __init__(
        self, landmarks: Landmarks, keyframes: Keyframes, seed: int, modes: Modes | None = None
    ) -> None:
        self._keyframes = keyframes
        every, self._landmark, self._most = landmarks.descriptor, np.arange(len(landmarks)), 1
        if modes is not None:
            every = joined(every, modes.descriptor)
            self._landmark = np.concatenate([self._landmark, modes.landmark])
            self._most += int(np.bincount(modes.landmark).max())
        self.words = learn_words(every, seed)
        word = nearest_words(every, self.words)[:, 0]
        order = np.argsort(word, kind="stable")
        self._landmark = self._landmark[order]
        self._offset = np.searchsorted(word[order], np.arange(len(self.words) + 1))
        self._rows = (every.values if isinstance(every, Descriptors) else every)[order]
        # Products with rows as they lie, divided by their lengths: cheaper than unit rows.
        self._length = np.empty(len(every), np.float32)
        block = max(1, _BLOCK // max(self._rows.shape[1], 1))
        for start in range(0, len(every), block):
            rows = self._rows[start : start + block].astype(np.float32)
            self._length[start : start + block] = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        np.maximum(self._length, 1e-12, out=self._length)
        self._seen = sparse.csr_matrix(
            (np.ones(len(keyframes.landmark), np.float32), keyframes.landmark, keyframes.offset),
            shape=(len(keyframes), len(landmarks)),
        )
        # Half way between counting votes and taking their share: a keyframe that saw much more
        # is not more likely by as much.
        self._weight = 1 / np.sqrt(np.maximum(np.diff(keyframes.offset), 1))

    def seen_by(self, keyframes: npt.ArrayLike) -> Indices:
        """The landmarks that some keyframes observed, each once and in order."""
        offset, landmark = self._keyframes.offset, self._keyframes.landmark
        seen = [landmark[offset[k] : offset[k + 1]] for k in np.atleast_1d(keyframes).tolist()]
        return np.unique(np.concatenate(seen)).astype(np.intp) if seen else np.empty(0, np.intp)

    def first_seen(self, keyframes: Indices, most: int) -> Indices:
        """The first `most` landmarks that some keyframes observed, one keyframe after the other."""
        offset, landmark = self._keyframes.offset, self._keyframes.landmark
        seen = np.concatenate([landmark[offset[k] : offset[k + 1]] for k in keyframes.tolist()])
        _, first = np.unique(seen, return_index=True)
        return np.sort(seen[np.sort(first)[:most]]).astype(np.intp)

    def seeing(self, landmarks: Indices, most: int) -> Indices:
        """The keyframes that observed most of some landmarks (N,), best first; none without any."""
        wanted = np.zeros(self._seen.shape[1], np.float32)
        wanted[landmarks] = 1
        count = self._seen @ wanted
        best = np.argsort(-count, kind="stable")[:most]
        return np.asarray(best[count[best] > 0], np.intp)

    def nearest(self, descriptors: F32) -> tuple[Indices, F32]:
        """Each descriptor's two nearest landmarks among those of its words.

        Takes unit descriptors (N, D); returns landmarks (N, 2) and their cosines (N, 2), -1 where
        there is none.
        """
        count = len(descriptors)
        searched = nearest_words(descriptors, self.words, min(_SEARCHED, len(self.words)))
        best, cosine = np.zeros((count, 2), np.intp), np.full((count, 2), -1, np.float32)
        flat = searched.ravel()
        order = np.argsort(flat, kind="stable")
        feature = order // searched.shape[1]
        border = np.searchsorted(flat[order], np.arange(len(self.words) + 1))
        for w in np.flatnonzero((np.diff(border) > 0) & (np.diff(self._offset) > 0)).tolist():
            rows = feature[border[w] : border[w + 1]]
            start, stop = self._offset[w : w + 2]
            product = descriptors[rows] @ self._rows[start:stop].astype(np.float32).T
            product /= self._length[start:stop]
            here = np.arange(len(rows))
            for _ in range(1 + self._most):
                top = product.argmax(axis=1)
                value, landmark = product[here, top], self._landmark[start + top]
                product[here, top] = -1
                first, second = value > cosine[rows, 0], value > cosine[rows, 1]
                if self._most > 1:  # no landmark is its own second
                    again = landmark == best[rows, 0]
                    nearer = rows[first & again]
                    cosine[nearer, 0] = value[first & again]
                    first, second = first & ~again, second & ~again
                moved, placed = rows[first], rows[second & ~first]
                best[moved, 1], cosine[moved, 1] = best[moved, 0], cosine[moved, 0]
                best[moved, 0], cosine[moved, 0] = landmark[first], value[first]
                best[placed, 1] = landmark[second & ~first]
                cosine[placed, 1] = value[second & ~first]
        return best, cosine

    def ranked(self, descriptors: F32, most: int | None = None) -> Indices:
        """The keyframes most like a frame with unit descriptors (N, D), best first."""
        landmark, cosine = self.nearest(descriptors)
        distance = np.sqrt(np.maximum(2 - 2 * cosine, 0))
        clear = distance[:, 0] < _MAX_RATIO * distance[:, 1]
        # What is there twice speaks for both places, and for each with half a voice.
        double = ~clear & (distance[:, 1] < _SAME_DISTANCE)
        votes = np.zeros(self._seen.shape[1], np.float32)
        votes[landmark[double].ravel()] = 0.5
        votes[landmark[clear, 0]] = 1  # several features that look like one landmark: a pattern
        score = (self._seen @ votes) * self._weight
        return np.asarray(np.argsort(-score, kind="stable")[:most], np.intp)

    def places(self, ranked: Indices, most: int, min_shared: float) -> list[Indices]:
        """Groups of ranked keyframes that share landmarks with the best of each, best first."""
        left: list[int] = ranked.tolist()
        groups: list[Indices] = []
        while left and len(groups) < most:
            seed = self.seen_by(left[0])
            together = [left[0]]
            for k in left[1:]:
                seen = self.seen_by(k)
                shared = np.isin(seen, seed, assume_unique=True).sum()
                if shared >= min_shared * min(len(seen), len(seed)):
                    together.append(k)
            groups.append(np.array(together, np.intp))
            left = [k for k in left if k not in together]
        return groups
