"""SIFT against every landmark with RANSAC, a frame at a time: what anyone would write first."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import F64, U8
from ground_station.features.methods.rootsift import RootSift
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map

_MAX_RATIO = 0.8
_THRESHOLD_PX = 3.0
_MIN_INLIERS = 12
_SEED = 0


class PlainLocalizer:
    """No motion, no place index, no memory: each frame is its own."""

    def __init__(self, map_: Map, camera: Camera, max_features: int = 1500) -> None:
        self._points = np.asarray(map_.landmarks.position_m, np.float64)
        self._descriptors = np.ascontiguousarray(np.asarray(map_.landmarks.descriptor).T)
        self._camera = camera
        self._extractor = RootSift(max_features)

    def locate(self, image: U8) -> F64 | None:
        """wTc (4, 4) of a grey frame (H, W), or None with fewer than 12 inliers.

        Ratio test of 0.8 and mutual nearest neighbours over all landmarks, P3P in locally optimised
        RANSAC with MAGSAC's score, then Levenberg–Marquardt on the inliers.
        """
        features = self._extractor.extract(image)
        if len(features) < _MIN_INLIERS:
            return None
        cosine = features.descriptors @ self._descriptors
        nearest = cosine.argmax(axis=1)
        rows = np.arange(len(cosine))
        best = cosine[rows, nearest]
        mutual = cosine.argmax(axis=0)[nearest] == rows
        cosine[rows, nearest] = -1.0
        second = cosine.max(axis=1)
        ratio = np.sqrt(np.maximum(2 - 2 * best, 0) / np.maximum(2 - 2 * second, 1e-12))
        feature = np.flatnonzero(mutual & (ratio < _MAX_RATIO))
        if len(feature) < _MIN_INLIERS:
            return None
        points = self._points[nearest[feature]]
        camera = self._camera
        pixels = camera.undistort_to_pinhole(features.keypoints_px[feature])
        params = cv2.UsacParams()
        params.threshold = _THRESHOLD_PX
        params.maxIterations = 5000
        params.confidence = 0.9999
        params.randomGeneratorState = _SEED
        params.sampler = cv2.SAMPLING_UNIFORM
        params.score = cv2.SCORE_METHOD_MAGSAC
        params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
        params.loIterations = 10
        params.loSampleSize = 30
        try:
            found, _, rvec, tvec, inliers = cv2.solvePnPRansac(
                points, pixels, camera.matrix, None, params=params
            )
        except cv2.error:
            return None
        if not found or inliers is None or len(inliers) < _MIN_INLIERS:
            return None
        i = inliers.ravel()
        rvec, tvec = cv2.solvePnPRefineLM(points[i], pixels[i], camera.matrix, None, rvec, tvec)
        if not np.isfinite(np.r_[rvec.ravel(), tvec.ravel()]).all():
            return None
        return poses.inverse(poses.pose(cv2.Rodrigues(rvec)[0], tvec.ravel()))
