"""A map made by hand: two rooms side by side that know nothing of each other but their wall."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Indices
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.inspection.prediction import View
from ground_station.map.store import Keyframes, Landmarks, Map, MapInfo

SIDE_M = 6.0
SIGMA_M = 0.004


def looking(position: npt.ArrayLike, heading_deg: float) -> F64:
    """wTc of a level camera."""
    c, s = np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))
    R = np.array([[s, 0, c], [-c, 0, s], [0, -1, 0]])
    return poses.pose(R, position)


def wall(rng: np.random.Generator, x_m: float, count: int) -> F64:
    """Points on the wall at x_m, 6 m wide and 3 m high."""
    return np.column_stack(
        [np.full(count, x_m), rng.uniform(0, SIDE_M, count), rng.uniform(0, 3, count)]
    )


def two_rooms(per_wall: int = 300, registered: bool = True) -> Map:
    """Rooms at x from 0 to 6 m and from 6 to 12 m, mapped along their walls at x = 6 m and 12 m.

    In each, keyframes look along x at its far wall, which is seen from its own room only, although
    the other room's wall projects into the pictures. What looks along -x is not mapped.
    """
    rng = np.random.default_rng(5)
    position = np.concatenate([wall(rng, SIDE_M, per_wall), wall(rng, 2 * SIDE_M, per_wall)])
    room_of = np.repeat([0, 1], per_wall)
    places = [(room, x, y) for room in (0, 1) for x in (1.0, 2.0, 3.0) for y in (2.0, 3.0, 4.0)]
    wTc = np.array([looking([SIDE_M * room + x, y, 1.5], 0.0) for room, x, y in places])
    view = View(THESIS_CAMERA)
    seen = []
    for (room, *_), pose in zip(places, wTc, strict=True):
        local = poses.transform(poses.inverse(pose), position)
        seen.append(np.flatnonzero(view.inside(local) & (room_of == room)))
    return made_of(position, wTc, seen, registered)


def made_of(position: F64, wTc: F64, seen: list[Indices], registered: bool = True) -> Map:
    """A map of landmarks (M, 3) that keyframes (K, 4, 4) saw, M of which nobody saw are kept."""
    landmark = np.concatenate(seen).astype(np.int32)
    image = np.repeat(np.arange(len(wTc)), [len(s) for s in seen])
    count = len(position)
    rays = wTc[image, :3, 3] - position[landmark]
    distance = np.linalg.norm(rays, axis=1)
    direction = np.zeros((count, 3))
    np.add.at(direction, landmark, rays / distance[:, None])
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    cosine = np.ones(count)
    np.minimum.at(cosine, landmark, np.sum(rays / distance[:, None] * direction[landmark], axis=1))
    near, far = np.full(count, 1e3), np.zeros(count)
    np.minimum.at(near, landmark, distance)
    np.maximum.at(far, landmark, distance)
    pixel = np.concatenate(
        [
            THESIS_CAMERA.project(poses.transform(poses.inverse(T), position[s]))
            for T, s in zip(wTc, seen, strict=True)
        ]
    )
    landmarks = Landmarks(
        id=np.arange(count, dtype=np.int64),
        position_m=position,
        covariance_m2=np.repeat(SIGMA_M**2 * np.eye(3, dtype=np.float32)[None], count, axis=0),
        descriptor=np.tile(np.float32([1.0, 0.0]), (count, 1)),
        spread=np.full(count, 0.1, np.float32),
        view_direction=direction.astype(np.float32),
        view_cos=cosine.astype(np.float32),
        distance_m=np.column_stack([near, far]).astype(np.float32),
        observations=np.bincount(landmark, minlength=count).astype(np.int32),
    )
    keyframes = Keyframes(
        names=[f"frame-{k:06d}" for k in range(len(wTc))],
        time_ns=np.arange(len(wTc), dtype=np.int64) * 100_000_000,
        wTc=wTc,
        offset=np.cumsum([0, *map(len, seen)], dtype=np.int64),
        landmark=landmark,
        pixel_px=pixel.astype(np.float32),
    )
    info = MapInfo("rootsift", "0" * 64, 2, THESIS_CAMERA, name="rooms")
    if registered:
        info.frame, info.units = "world", "m"
    return Map(info, landmarks, keyframes)
