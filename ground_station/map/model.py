"""A COLMAP model as arrays: images, points, and which image sees which point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64, I64
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map


@dataclass(frozen=True)
class Model:
    """A COLMAP model as arrays, in our conventions.

    `names`, K image names and `image_id` (K,) their ids, in order of id; `wTc` (K, 4, 4);
    `point_id` (M,), `position` (M, 3). Observation o is key point `feature[o]` of image `image[o]`
    (an index into `names`), an observation of point `point[o]` (an index into `point_id`), at
    `pixel_px[o]` (O, 2), undistorted pixels of `camera`, which took all images.
    """

    names: list[str]
    image_id: I64
    wTc: F64
    point_id: I64
    position: F64
    image: I64
    feature: I64
    point: I64
    pixel_px: F64
    camera: Camera

    @property
    def pinhole(self) -> F64:
        """fx, fy, cx, cy (4,), pixels."""
        camera = self.camera
        return np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])


def model_of(map_: Map) -> Model:
    """A map's poses, landmarks and observations, its pixels undistorted."""
    camera, lm, kf = map_.info.camera, map_.landmarks, map_.keyframes
    image = np.repeat(np.arange(len(kf)), np.diff(kf.offset))
    return Model(
        names=list(kf.names),
        image_id=np.arange(len(kf)) + 1,
        wTc=np.array(kf.wTc),
        point_id=lm.id,
        position=np.array(lm.position_m),
        image=image,
        feature=np.zeros(len(image), np.int64),
        point=kf.landmark.astype(np.int64),
        pixel_px=camera.undistort_to_pinhole(kf.pixel_px),
        camera=camera,
    )
