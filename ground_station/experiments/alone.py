"""The plain baseline: each frame by itself, against every landmark of the map.

No motion, no time, no prediction: mutually nearest descriptors that pass the ratio test (Lowe, IJCV
2004, 7.1), COLMAP's LO-RANSAC and refinement of the pose. Whoever has motion and time must not be
worse.
"""

from __future__ import annotations

import time

import numpy as np

from ground_station.arrays import U8
from ground_station.features.extractor import Extractor
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.estimate import Counts, PoseEstimate, State
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.relocalization import match_all
from ground_station.map.colmap import colmap_camera
from ground_station.map.colmap_cameras import HALF_PIXEL
from ground_station.map.store import Map

FEATURES = 2000
_MAX_RATIO, _MAX_ERROR_PX, _MIN_INLIERS = 0.8, 6.0, 12


class Alone:
    """Localizes frames one by one, called as a `Localizer` is."""

    def __init__(self, map_: Map, camera: Camera, extractor: Extractor) -> None:
        self._points_m = map_.landmarks.position_m
        self._descriptors = map_.landmarks.descriptor[:]
        self._camera, self._extractor = colmap_camera(camera), extractor

    def process(
        self, time_ns: int, image: U8, index: int = 0, exposure_s: float | None = None
    ) -> PoseEstimate:
        """TRACKING with a pose, or LOST."""
        import pycolmap

        begun_s = time.perf_counter()
        features = self._extractor.extract(image)
        feature, landmark = match_all(features.descriptors, self._descriptors, _MAX_RATIO)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = _MAX_ERROR_PX
        found = None
        if len(feature) >= _MIN_INLIERS:
            found = pycolmap.estimate_and_refine_absolute_pose(
                features.keypoints_px[feature].astype(np.float64) + HALF_PIXEL,
                self._points_m[landmark], self._camera, options,
            )  # fmt: skip
        inliers = int(found["num_inliers"]) if found else 0
        wTc = None
        if found and inliers >= _MIN_INLIERS:
            cTw = found["cam_from_world"].matrix()
            wTc = poses.inverse(poses.pose(cTw[:, :3], cTw[:, 3]))
        return PoseEstimate(
            time_ns,
            index,
            State.LOST if wTc is None else State.TRACKING,
            wTc=wTc,
            counts=Counts(len(self._points_m), inliers),
            stage_ms={"total": 1e3 * (time.perf_counter() - begun_s)},
        )

    def smoothed(self) -> list[Kinematics]:
        """Nothing: no frame helps another."""
        return []

    finish = smoothed
