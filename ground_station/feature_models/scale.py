"""How far a model's descriptors of one point in two views are apart, beside RootSIFT's.

Limits of descriptor distance are named for RootSIFT. Networks lay out their space as they were
trained: the same limit would drop right matches of one and let wrong ones of another pass.
"""

from __future__ import annotations

import functools
import hashlib
import os
from pathlib import Path

import numpy as np

from ground_station.arrays import F64, U8
from ground_station.feature_models import homographic
from ground_station.feature_models.degrade import degrade
from ground_station.feature_models.images import procedural
from ground_station.features.extractor import Extractor
from ground_station.features.extractors import of_network
from ground_station.features.inference import Network
from ground_station.features.methods.rootsift import RootSift
from ground_station.features.model_info import SCALES, Model, ModelInfo

_PAIRS, _SIZE, _SEED = 8, (240, 320), 7
_FEATURES = 500
_RULER_CONTRAST = 0.02
"""The threshold of RootSIFT when its limits of distance were studied: fainter key points are a
hundredth further apart, and the ruler must not move, for each model's file holds a ratio to it."""
_SHARE = 0.9
"""Of the right matches: what is limited are the far ones."""
_LEAST = 200
"""Right matches below which nothing is said: the network is none, or not for such pictures."""

Pairs = list[tuple[U8, U8, F64]]


def measured(data: bytes, info: ModelInfo) -> float:
    """The scale of a model's file that was found harmless, with as many threads as there are cores.

    What `distance_scale` says of it.
    """
    model = Model(Path(info.name), info, data, hashlib.sha256(data).hexdigest())
    return distance_scale(of_network(Network(model, threads=os.cpu_count() or 1), _FEATURES))


def distance_scale(extractor: Extractor) -> float:
    """How far nine of ten right mutual matches are within, L2, over RootSIFT's on the same pairs.

    The pairs are procedural pictures and warps of them, both in light, blur and noise of their
    own, 240x320. 1.0 where there are too few right matches to tell; within `model.SCALES`.
    """
    own = _right_distances(extractor, _pairs())
    if len(own) < _LEAST:
        return 1.0
    return float(np.clip(np.round(np.quantile(own, _SHARE) / _rootsift(), 2), *SCALES))


@functools.cache
def _pairs() -> Pairs:
    rng = np.random.default_rng(_SEED)
    pairs = []
    for index in range(_PAIRS):
        picture = procedural(_SEED, index, _SIZE)
        warped, matrix = homographic.warp(picture, rng)
        pairs.append((degrade(picture, rng), degrade(warped, rng), matrix))
    return pairs


@functools.cache
def _rootsift() -> float:
    ruler = RootSift(_FEATURES, _RULER_CONTRAST)
    return float(np.quantile(_right_distances(ruler, _pairs()), _SHARE))


def _right_distances(extractor: Extractor, pairs: Pairs) -> F64:
    """The descriptor distances of all mutual nearest matches that are where the truth says."""
    found = [np.empty(0)]
    for first, second, matrix in pairs:
        one, other = extractor.extract(first), extractor.extract(second)
        again = homographic.found_again(one, other, matrix, (first.shape, second.shape))
        right = again.matches[again.apart_px <= homographic.NEAR_PX]
        apart = one.descriptors[right[:, 0]] - other.descriptors[right[:, 1]]
        found.append(np.linalg.norm(apart, axis=1))
    return np.concatenate(found)
