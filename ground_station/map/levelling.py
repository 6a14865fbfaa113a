"""A map in other coordinates: moved by a similarity, or turned so that z is up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.geometry.alignment import Alignment
from ground_station.map.store import Map

_UP = {0: (1, -1), 90: (0, -1), 180: (1, 1), 270: (0, 1)}
"""The camera's axis and its sign that is up in pictures which displays turn clockwise so far."""


def transformed(map_: Map, fit: Alignment) -> Map:
    """The map with poses, positions, covariances, directions and distances in the new frame."""
    lm, kf = map_.landmarks, map_.keyframes
    R, s = fit.rotation, fit.scale
    covariance = s**2 * (R @ lm.covariance_m2.astype(np.float64) @ R.T)
    moved = replace(
        lm,
        position_m=fit.apply(lm.position_m),
        covariance_m2=covariance.astype(np.float32),
        view_direction=(lm.view_direction @ R.T).astype(np.float32),
        distance_m=(s * lm.distance_m).astype(np.float32),
        by_focal_m=(s * lm.by_focal_m @ R.T).astype(np.float32),
    )
    keyframes = replace(kf, wTc=fit.apply_poses(kf.wTc))
    return replace(map_, info=replace(map_.info), landmarks=moved, keyframes=keyframes)


def levelled(map_: Map) -> Map:
    """The map with z up: as it is once registered; else turned so that its cameras stand upright.

    Upright is as displays show the pictures, which they may turn from how they are stored.
    """
    if map_.info.registered or not len(map_.keyframes):
        return map_
    axis, sign = _UP.get(map_.info.built.get("display_deg", 0), _UP[0])
    up = sign * map_.keyframes.wTc[:, :3, axis].mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        return map_
    z = up / length
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return transformed(map_, Alignment(np.stack([x, np.cross(z, x), z]), np.zeros(3), 1.0))
