"""What a camera at a pose would see of a map, and how well that would fix its pose.

A map knows no walls. It knows from where each landmark was seen, and from where it was not although
it projected into the picture: hidden, too oblique, too small, or not found again. A keyframe that
looked from nearly the same direction and distance therefore tells most of a place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, I64, Bools
from ground_station.geometry import poses
from ground_station.geometry.camera import NEAREST_M, Camera
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
        keep[keep] = self.camera.inside(front[:, :2] / front[:, 2:])
        return keep.reshape(shape)


class Visibility:
    """Every landmark with the keyframes whose pictures it lies in, and whether they saw it.

    `rows` (M,) are the map's landmarks that are looked at, each of which stands for `weight`.
    """

    def __init__(self, map_: Map) -> None:
        lm, kf = map_.landmarks, map_.keyframes
        step = max(1, -(-len(lm) // MOST_LANDMARKS))
        self.rows = np.arange(0, len(lm), step)
        self.weight = len(lm) / max(len(self.rows), 1)
        self.position = lm.position_m[self.rows]
        at = np.full(len(lm), -1, np.int64)
        at[self.rows] = np.arange(len(self.rows))
        view = View.of(map_)
        landmark: list[I64] = []
        ray: list[F64] = []
        seen: list[Bools] = []
        for k in range(0, len(kf), max(1, -(-len(kf) // MOST_KEYFRAMES))):
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


_LEAST_CHANCE = 0.02
"""Landmarks less likely than this are not projected."""
_WEAK = 1e-6
"""Information that keeps a pose without landmarks invertible: 1,000 of its units."""
SIGMA_PX, NEEDED, MOST = 2.0, 20, 1500
"""As the localizer's preset `default` has them, to which a test holds them: an observation's
deviation, landmarks below which there is no keyframe to follow, observations solved at once."""


@dataclass(frozen=True)
class Prediction:
    """Of views (...): `count`, landmarks expected to be found; standard deviations of the pose.

    `sigma_m`, of the position, is the root of its covariance's trace (in the map's units where it
    is not registered), `sigma_deg` that of the rotation.
    """

    count: F64
    sigma_m: F64
    sigma_deg: F64

    @property
    def lost(self) -> Bools:
        """Where fewer landmarks are expected than are followed; to be found again it takes more."""
        return self.count < NEEDED


class Predictor:
    """A map, asked from many places."""

    def __init__(self, map_: Map) -> None:
        self._observations = Visibility(map_)
        self._view = View.of(map_)
        covariance = map_.landmarks.covariance_m2[self._observations.rows].astype(np.float64)
        values, vectors = np.linalg.eigh(covariance)
        self._root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        """Of each landmark's covariance (M, 3, 3): it times its transpose."""

    def places(self, position_m: npt.ArrayLike, wRc: npt.ArrayLike) -> Prediction:
        """Of cameras at N places (N, 3), each turned to H rotations (H, 3, 3): arrays (N, H)."""
        places, R = np.asarray(position_m, np.float64).reshape(-1, 3), np.asarray(wRc, np.float64)
        rows = [self._at(place, R) for place in places]
        table = np.array(rows).reshape(len(places), len(R), 3)
        return Prediction(table[..., 0], table[..., 1], table[..., 2])

    def _at(self, position_m: F64, wRc: F64) -> F64:
        """Count, position's and rotation's deviation of each rotation (H, 3, 3); (H, 3)."""
        chance = self._observations.chance(position_m)
        near = np.flatnonzero(chance > _LEAST_CHANCE)
        local = (self._observations.position[near] - position_m) @ wRc  # (H, n, 3)
        which, index = np.nonzero(self._view.inside(local))
        weight = chance[near[index]] * self._observations.weight
        count = np.bincount(which, weight, len(wRc))
        rows = self._whitened(local[which, index], wRc[which], self._root[near[index]])
        rows *= np.sqrt(weight)[:, None, None]
        ends = np.searchsorted(which, np.arange(len(wRc) + 1))
        information = np.empty((len(wRc), 6, 6))
        for h in range(len(wRc)):
            mine = rows[ends[h] : ends[h + 1]].reshape(-1, 6)
            information[h] = mine.T @ mine
        solved = np.minimum(1.0, MOST / np.maximum(count, 1e-9))
        information = information * solved[:, None, None] + _WEAK * np.eye(6)
        variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
        sigma = np.sqrt(np.maximum(variance, 0.0).reshape(-1, 2, 3).sum(axis=2))
        return np.stack([count, sigma[:, 1], np.degrees(sigma[:, 0])], axis=1)

    def _whitened(self, X: F64, wRc: F64, root: F64) -> F64:
        """Jacobians (n, 2, 6) of the pixel by the pose, in standard deviations of the pixel.

        `X` (n, 3) in camera coordinates, `wRc` (n, 3, 3), `root` (n, 3, 3) of the landmark's
        covariance, which adds to the pixel's noise. The pose's tangent is rotation first, in camera
        axes: the derivative of X by it is ([X]x, -I).
        """
        camera = self._view.camera
        z = X[:, 2]
        du = np.zeros_like(X)
        dv = np.zeros_like(X)
        du[:, 0], du[:, 2] = camera.fx_px / z, -camera.fx_px * X[:, 0] / z**2
        dv[:, 1], dv[:, 2] = camera.fy_px / z, -camera.fy_px * X[:, 1] / z**2
        # By the landmark in world axes, and then in its own deviations.
        a, b = (np.einsum("ni,nij->nj", np.einsum("ni,nji->nj", d, wRc), root) for d in (du, dv))
        flat = np.stack([X[:, 0] / z, X[:, 1] / z], axis=1)
        square = (SIGMA_PX * camera.lens.stretch(flat)) ** 2
        l11 = np.sqrt(np.einsum("ni,ni->n", a, a) + square)
        l21 = np.einsum("ni,ni->n", a, b) / l11
        l22 = np.sqrt(np.maximum(np.einsum("ni,ni->n", b, b) + square - l21**2, square))
        J = np.stack([np.hstack([np.cross(d, X), -d]) for d in (du, dv)], axis=1)
        J[:, 0] /= l11[:, None]
        J[:, 1] = (J[:, 1] - l21[:, None] * J[:, 0]) / l22[:, None]
        return J
