"""A flight's lens against the one that its map was made with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map, MapInfo
from ground_station.map.uncertainty import accuracy

_SAME = 1e-6
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


def against_map(info: MapInfo, camera: Camera) -> tuple[Camera, bool]:
    """The lens by which a flight sees a map, and whether it is the map's own.

    Where the map's pictures denied the lens that was given with them, and the flight comes with
    just that one, it is the same camera and has the lens that was found.
    """
    mine, built = info.camera, info.built.get("lens", {})
    if _alike(_lens(camera), _lens(mine)) and camera.model == mine.model:
        return camera, True
    given = built.get("given", {})
    size = camera.width_px == mine.width_px and camera.height_px == mine.height_px
    if built.get("state") == "found" and size and set(given) == set(_LENS):
        known = replace(camera, **given)
        if camera.model == mine.model and _alike(_lens(camera), _lens(known)):
            return replace(camera, **{name: getattr(mine, name) for name in _LENS}), True
    return camera, False


def considered(map_: Map, is_maps: bool, sigma: float) -> F64:
    """Covariance (2, 2) of the shares by which a flight's and its map's focal lengths are off.

    `sigma` is of one lens against another, each by its own calibration. A wrong lens bends the map:
    where that is registered by a trajectory, its scatter about that has been measured, and a few
    points say nothing of it.
    """
    of_one = sigma**2 / 2
    measured = accuracy(map_.info).sigma_rad > 0
    bends = map_.info.registered and not measured and bool(map_.landmarks.by_focal_m.any())
    if is_maps:
        return np.full((2, 2), of_one if bends else 0.0)
    return np.diag([sigma**2, of_one if bends else 0.0])


def _lens(camera: Camera) -> F64:
    """Its numbers (9,), of a picture one unit wide."""
    shape = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] + np.array([0, 0, 0.5, 0.5])
    return np.concatenate([shape / camera.width_px, camera.distortion])


def _alike(a: F64, b: F64) -> bool:
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=0, atol=_SAME))
