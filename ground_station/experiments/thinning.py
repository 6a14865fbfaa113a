"""A map with fewer landmarks, and which ones it keeps.

The greedy cover of Li, Snavely and Huttenlocher (ECCV 2010), which wants every view to see enough
of them, made soft, as by Lynen et al. (IJRR 2020): a landmark's gain falls with what the views that
see it have already, and with what the same part of their picture has.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ground_station.arrays import F64, Indices
from ground_station.experiments.viewpoints import ExpectedObservations, expected_observations
from ground_station.map.descriptors import Descriptors
from ground_station.map.store import Landmarks, Map, MapInfo
from ground_station.progress import Progress

_ROUNDS = 200
"""Those that gain most are taken together in so many rounds, whatever the map's size; one by one
(then it is the greedy algorithm) takes their number times as long and covers no better."""
_SIGMA_PX = 1.0
"""Of a feature's place in the picture: a landmark that is known worse than this counts less."""
_NEAREST, _FARTHEST = 5.0, 0.2
"""What a landmark's nearness counts, at most and at least: it fixes the place so much better."""
_SPREAD = 0.35
"""Half the distance of descriptors at which the localizer gives up; one that has varied more
counts less."""


def choose(map_: Map, count: int) -> Indices:
    """The landmarks (count,) that are kept, in order; all when there are no more."""
    total = len(map_.landmarks)
    if count >= total:
        return np.arange(total)
    with Progress("viewpoints, keyframes", len(map_.keyframes)) as progress:
        observations = expected_observations(map_, progress.step)
    return np.sort(cover(observations, quality(map_.landmarks, map_.info.camera.fx_px), count))


def quality(landmarks: Landmarks, focal_px: float) -> F64:
    """How much an observation of each landmark (M,) tells, above 0.

    More for one that is nearer than most; less for one whose place across the line of sight
    is not known to a pixel, as seen from the distance it was seen from, and for one that did not
    always look the same."""
    covariance = landmarks.covariance_m2.astype(np.float64)
    ray = landmarks.view_direction.astype(np.float64)
    along = np.einsum("mi,mij,mj->m", ray, covariance, ray)
    across = np.maximum(np.trace(covariance, axis1=1, axis2=2) - along, 0) / 2
    distance = np.sqrt(np.prod(landmarks.distance_m.astype(np.float64), axis=1))
    square_px = focal_px**2 * across / np.maximum(distance, 1e-9) ** 2
    steady = 1 / (1 + (landmarks.spread.astype(np.float64) / _SPREAD) ** 2)
    near = np.clip(np.median(distance) / np.maximum(distance, 1e-9), _FARTHEST, _NEAREST)
    return np.asarray(near * steady * _SIGMA_PX**2 / (_SIGMA_PX**2 + square_px))


def cover(
    observations: ExpectedObservations, quality: F64, count: int, rounds: int = _ROUNDS
) -> Indices:
    """`count` of M landmarks that cover the views, the best first; quality (M,).

    Greedily minimises the sum over views of w / (1 + A), as a pose's variance falls with what fixes
    it; A is the sum over a picture's cells of sqrt(1 + n) - 1, n the quality that the chosen
    landmarks are expected to show there. What one landmark gains only falls while others are
    chosen (its negative is submodular), so the greedy choice is near the best.
    """
    worth = quality[observations.landmark] * observations.chance
    filled: F64 = np.zeros(observations.cells)
    covered: F64 = np.zeros(len(observations.weight))
    left = np.ones(len(quality), bool)
    kept: list[Indices] = []
    together = -(-count // rounds)
    missing = count
    while missing:
        before = filled[observations.cell]
        gain = np.sqrt(1 + before + worth) - np.sqrt(1 + before)
        gain *= (observations.weight / np.square(1 + covered))[observations.view]
        total = np.bincount(observations.landmark, gain, len(quality))
        # What no view sees comes last, by its quality.
        order = np.lexsort((-quality, np.where(left, -total, np.inf)))[: min(together, missing)]
        kept.append(order)
        left[order] = False
        missing -= len(order)
        new = np.flatnonzero(~left[observations.landmark] & (worth > 0))
        filled = np.bincount(observations.cell[new], worth[new], observations.cells).astype(
            np.float64
        )
        in_view = np.sqrt(1 + filled).reshape(len(covered), -1) - 1
        covered = in_view.sum(axis=1)
    return np.concatenate([*kept, np.empty(0, np.intp)]).astype(np.intp)


def subset(map_: Map, kept: Indices) -> Map:
    """The map with some of its landmarks (N,), in order, their modes, and all of its keyframes."""
    lm, kf = map_.landmarks, map_.keyframes
    names = [field.name for field in dataclasses.fields(Landmarks)]
    rows = {name: getattr(lm, name)[kept] for name in names if name != "descriptor"}
    descriptor = lm.descriptor
    rows["descriptor"] = (
        descriptor.rows(kept) if isinstance(descriptor, Descriptors) else descriptor[kept]
    )
    place = np.full(len(lm), -1, np.int64)
    place[kept] = np.arange(len(kept))
    landmark = place[kf.landmark]
    left = landmark >= 0
    keyframes = dataclasses.replace(
        kf,
        offset=np.concatenate([[0], np.cumsum(left)])[kf.offset],
        landmark=landmark[left].astype(np.int32),
        pixel_px=kf.pixel_px[left],
    )
    modes = map_.modes.among(place >= 0) if map_.modes is not None else None
    info = MapInfo(**vars(map_.info))
    return Map(info, Landmarks(**rows), keyframes, map_.folder, modes)
