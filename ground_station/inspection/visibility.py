"""How likely a landmark is found from a place, as the map's own keyframes tell it.

A map knows no walls. It knows from where each landmark was seen, and from where it was not although
it projected into the picture: hidden, too oblique, too small, or not found again. A keyframe that
looked from nearly the same direction and distance therefore tells most of a place.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, I64, Bools
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens import NEAREST_M, Lens
from ground_station.map.store import Map

ANGLE_RAD = np.deg2rad(25.0)
"""A keyframe that looked from so far aside counts exp(-1/2): in three dimensions no detector and
descriptor holds beyond 25 to 30 degrees (Moreels and Perona, IJCV 2007)."""
LOG_DISTANCE = np.log(1.5)
"""And one from so many times the distance, or so many times nearer."""
FARTHEST = 2.5
"""A keyframe further aside than so many of these tells nothing."""
PRIOR = 1.0
"""A keyframe's worth of not having found it: one observation from right here is a chance of 1/2."""

MOST_LANDMARKS, MOST_KEYFRAMES = 20_000, 400
"""Of larger maps one in so many is looked at, which then stands for them."""


class View:
    """What is before a camera and in its image."""

    def __init__(self, camera: Camera, nearest: float = NEAREST_M) -> None:
        self.camera, self._nearest = camera, nearest
        self._lens = Lens(camera)

    @classmethod
    def of(cls, map_: Map) -> View:
        """That of a map's camera; lengths of a map that is not registered say nothing of metres."""
        return cls(map_.info.camera, NEAREST_M if map_.info.registered else 0.0)

    def inside(self, points_c: F64) -> Bools:
        """Whether points in camera coordinates (..., 3) are in front and in the image; (...)."""
        shape = points_c.shape[:-1]
        points = points_c.reshape(-1, 3)
        keep = points[:, 2] > self._nearest
        front = points[keep]
        keep[keep] = self._lens.inside(front[:, :2] / front[:, 2:])
        return keep.reshape(shape)


class Visibility:
    """Every landmark with the keyframes whose pictures it lies in, and whether they saw it.

    `rows` (M,) are the map's landmarks that are looked at, each of which stands for `weight`.
    """

    def __init__(
        self,
        map_: Map,
        most_landmarks: int = MOST_LANDMARKS,
        most_keyframes: int = MOST_KEYFRAMES,
    ) -> None:
        lm, kf = map_.landmarks, map_.keyframes
        step = max(1, -(-len(lm) // most_landmarks))
        self.rows = np.arange(0, len(lm), step)
        self.weight = len(lm) / max(len(self.rows), 1)
        self.position = lm.position_m[self.rows]
        at = np.full(len(lm), -1, np.int64)
        at[self.rows] = np.arange(len(self.rows))
        view = View.of(map_)
        landmark: list[I64] = []
        ray: list[F64] = []
        seen: list[Bools] = []
        for k in range(0, len(kf), max(1, -(-len(kf) // most_keyframes))):
            here = np.zeros(len(self.rows), bool)
            observations = at[kf.landmark[kf.offset[k] : kf.offset[k + 1]]]
            here[observations[observations >= 0]] = True
            local = poses.transform(poses.inverse(kf.wTc[k]), self.position)
            # An observation at the border may project just outside: it was seen all the same.
            shown = np.flatnonzero(view.inside(local) | here)
            landmark.append(shown)
            ray.append(kf.wTc[k, :3, 3] - self.position[shown])
            seen.append(here[shown])
        landmarks = np.concatenate([*landmark, np.empty(0, np.int64)])
        order = np.argsort(landmarks, kind="stable")
        self._landmark = landmarks[order]
        rays = np.concatenate([*ray, np.empty((0, 3))])[order]
        distance = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
        self._direction = (rays / distance[:, None]).astype(np.float32)
        self._log_distance = np.log(distance).astype(np.float32)
        self._seen = np.concatenate([*seen, np.empty(0, bool)])[order]

    def chance(self, position_m: npt.ArrayLike) -> F64:
        """How likely each landmark is found from a place (3,) if the camera looks at it; (M,).

        w S / (C + w): S keyframes saw it and C could have, counted by weights that fall with how
        differently they looked, of which w is the largest. Keyframes far off, however many, make
        nothing certain.
        """
        rays = np.asarray(position_m) - self.position
        distance = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
        direction = (rays / distance[:, None]).astype(np.float32)
        log_distance = np.log(distance).astype(np.float32)
        cosine = np.einsum("pi,pi->p", direction[self._landmark], self._direction)
        near = np.flatnonzero(cosine > np.cos(FARTHEST * ANGLE_RAD))
        count = len(self.rows)
        if not len(near):
            return np.zeros(count)
        landmark = self._landmark[near]
        ratio = (log_distance[landmark] - self._log_distance[near]) / LOG_DISTANCE
        # 2 (1 - cos) is the angle's square, near enough.
        weight = np.exp((cosine[near] - 1) / ANGLE_RAD**2 - 0.5 * ratio**2)
        begins = np.flatnonzero(np.diff(landmark, prepend=-1))
        best = np.zeros(count)
        best[landmark[begins]] = np.maximum.reduceat(weight, begins)
        found = np.bincount(landmark, weight * self._seen[near], count)
        could = np.bincount(landmark, weight, count)
        return np.asarray(best * found / np.maximum(could + PRIOR * best, 1e-12))
