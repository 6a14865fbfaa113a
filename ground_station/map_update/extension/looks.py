"""Which landmarks of a map look otherwise than it knows: their new descriptor modes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F32, I64
from ground_station.map.store import Map
from ground_station.map_update.extension.merging import distance_to_landmarks, mean_descriptors
from ground_station.mapping.settings import MappingSettings

_MOST_SPREAD = 0.6
"""RMS distance of a mode's observations from their mean, beyond which they are not one look."""
_FEWEST = 3
"""Frames that must have seen a mode: two may share what hid the landmark."""


@dataclass(frozen=True)
class Looks:
    """New modes: `landmark` (N,) and `descriptor` (N, D).

    `seen` landmarks of the map were seen; `near` of their observations were as the map knows them,
    `far` were not; `full` landmarks had as many modes as they may."""

    landmark: I64
    descriptor: F32
    seen: int
    near: int
    far: int
    full: int


def new_looks(map_: Map, landmark: I64, descriptor: F32, settings: MappingSettings) -> Looks:
    """The modes that observations of landmarks (O,) with descriptors (O, D) give.

    An observation is far when its descriptor is further from all that the landmark has than
    `mode_distance` and than `mode_spreads` times the landmark's spread. Far ones, of at least
    three frames and alike among themselves, become a mode: their mean. What is near
    changes nothing, so that a landmark goes on to look in its first light as it did.
    """
    wanted, lm = settings.extend, map_.landmarks
    distance = distance_to_landmarks(map_, descriptor, landmark)
    limit = np.maximum(wanted.mode_distance, wanted.mode_spreads * lm.spread[landmark])
    far = np.flatnonzero(distance > limit)
    shown, group, count = np.unique(landmark[far], return_inverse=True, return_counts=True)
    group = group.ravel()
    mean = mean_descriptors(descriptor[far], group, len(shown))
    square = np.sum((descriptor[far] - mean[group]) ** 2, axis=1)
    spread = np.sqrt(np.bincount(group, square, len(shown)) / np.maximum(count, 1))
    good = (count >= _FEWEST) & (spread <= _MOST_SPREAD)
    had = np.zeros(len(lm), np.int64)
    if map_.modes is not None:
        had = np.bincount(map_.modes.landmark, minlength=len(lm))
    room = had[shown] < wanted.max_modes
    return Looks(
        landmark=shown[good & room],
        descriptor=mean[good & room],
        seen=len(np.unique(landmark)),
        near=len(landmark) - len(far),
        far=len(far),
        full=int((good & ~room).sum()),
    )
