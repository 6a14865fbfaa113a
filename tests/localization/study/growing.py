"""A map with other buildings beside it, to see what its size does to relocalization."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from ground_station.map.store import Keyframes, Landmarks, Map


def grown(map_: Map, times: int) -> Map:
    """The map with `times` - 1 other buildings of its size beside it.

    Their descriptors mix two of its own each: as crowded, and alike only by chance.
    """
    kf, rng = map_.keyframes, np.random.default_rng(times)
    lm = replace(map_.landmarks, descriptor=np.asarray(map_.landmarks.descriptor, np.float32))
    landmarks, keyframes = [lm], [kf]
    for k in range(1, times):
        one, other = rng.permutation(len(lm)), rng.permutation(len(lm))
        described = np.asarray(lm.descriptor)
        mixed = described[one] + described[other]
        mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
        aside = np.array([40.0 * k, 0, 0])
        landmarks.append(replace(lm, position_m=lm.position_m + aside, descriptor=mixed))
        wTc = kf.wTc.copy()
        wTc[:, :3, 3] += aside
        seen = (kf.landmark + k * len(lm)).astype(np.int32)
        offset = kf.offset[1:] + k * len(kf.landmark)
        keyframes.append(replace(kf, wTc=wTc, landmark=seen, offset=offset))
    every = {f.name: np.concatenate([getattr(x, f.name) for x in landmarks]) for f in fields(lm)}
    observations = {
        f.name: np.concatenate([getattr(x, f.name) for x in keyframes])
        for f in fields(kf)
        if f.name != "names"
    }
    names = [name for x in keyframes for name in x.names]
    return replace(
        map_, landmarks=Landmarks(**every), keyframes=Keyframes(names=names, **observations)
    )
