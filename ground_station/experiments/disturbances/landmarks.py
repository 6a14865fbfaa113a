"""A map with fewer landmarks."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ground_station.arrays import Indices
from ground_station.experiments.disturbance import Disturbance
from ground_station.map.descriptors import Descriptors
from ground_station.map.store import Landmarks, Map, MapInfo
from pi_firmware.wire import config


@dataclass(frozen=True)
class Fewer(Disturbance):
    """By one seed, a smaller share of the landmarks is in a larger one."""

    landmarks: float = config.key(
        1.0, "share of the map's landmarks that is there, drawn at random", low=0.01, high=1.0
    )

    def map(self, map_: Map, seed: int) -> Map:
        total = len(map_.landmarks)
        order = np.random.default_rng(seed).permutation(total)
        return subset(map_, np.sort(order[: round(self.landmarks * total)]))


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


DISTURBANCE = Fewer
