"""A map with z up, registered or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.geometry import poses
from ground_station.map.store import Map

_UP = {0: (1, -1), 90: (0, -1), 180: (1, 1), 270: (0, 1)}
"""The camera's axis and its sign that is up in pictures which displays turn clockwise so far."""


def levelled(map_: Map) -> Map:
    """The map with z up: as it is once registered; else turned so that its cameras stand upright.

    Upright is as displays show the pictures, which they may turn from how they are stored. Only
    positions, poses, view directions and covariances are turned.
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
    R = np.stack([x, np.cross(z, x), z])
    lm, kf = map_.landmarks, map_.keyframes
    turned = replace(
        lm,
        position_m=lm.position_m @ R.T,
        covariance_m2=(R @ lm.covariance_m2 @ R.T).astype(np.float32),
        view_direction=(lm.view_direction @ R.T).astype(np.float32),
    )
    return replace(
        map_,
        landmarks=turned,
        keyframes=replace(kf, wTc=poses.pose(R, np.zeros(3)) @ kf.wTc),
    )
