"""Which directions are in a camera's image."""

from __future__ import annotations

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera

NEAREST_M = 0.05
"""Nearer than this a landmark has no useful projection."""


class Lens:
    """A camera with what is needed to tell quickly whether a direction is in its image.

    A distortion polynomial folds back far outside of the image, so that directions no pixel sees
    would land inside; `max_radius` bounds them on the plane z = 1. Of a fisheye it is what is used.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        w, h = camera.width_px - 0.5, camera.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [w, -0.5], [-0.5, h], [w, h]])
        farthest = 1.02 * float(np.linalg.norm(camera.undistort(corners), axis=1).max())
        reach = camera.lens.reach
        self.max_radius = farthest if farthest < reach else reach  # also where that is not a number

    def inside(self, normalized: F64) -> Bools:
        """Whether directions (N, 2) on the plane z = 1 land in the image; (N,)."""
        camera = self.camera
        near = np.einsum("ij,ij->i", normalized, normalized) <= self.max_radius**2
        pixels = camera.distort(normalized[near])
        near[near] = (
            (pixels[:, 0] >= -0.5)
            & (pixels[:, 1] >= -0.5)
            & (pixels[:, 0] < camera.width_px - 0.5)
            & (pixels[:, 1] < camera.height_px - 0.5)
        )
        return np.asarray(near)
