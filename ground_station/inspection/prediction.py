"""What a camera at a pose would see of a map, and how well that would fix its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Bools
from ground_station.inspection.visibility import View, Visibility
from ground_station.map.store import Map

_LEAST_CHANCE = 0.02
"""Landmarks less likely than this are not projected."""
_WEAK = 1e-6
"""Information that keeps a pose without landmarks invertible: 1,000 of its units."""
SIGMA_PX, NEEDED, MOST = 2.0, 20, 400
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
