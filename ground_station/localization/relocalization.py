"""The camera's pose from the whole map, without a guess."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import RecoverySettings
from ground_station.mapping.store import Landmarks

Array = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

_BLOCK = 8_000_000
"""Descriptor products held at once: 32 MB."""


@dataclass(frozen=True)
class Relocalization:
    """A pose (4, 4) and its inliers: `feature` (N,) and `landmark` (N,) indices."""

    wTc: Array
    feature: Indices
    landmark: Indices


def match_all(descriptors: F32, landmarks: F32, max_ratio: float) -> tuple[Indices, Indices]:
    """Mutual nearest neighbours of unit descriptors (F, D) and (L, D) that pass the ratio test.

    Returns indices (N,) and (N,). The ratio is of L2 distances, over each feature's two nearest.
    """
    count, total = len(descriptors), len(landmarks)
    if count == 0 or total < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    best, best_cos = np.empty(count, np.intp), np.empty(count, np.float32)
    second_cos = np.empty(count, np.float32)
    back, back_cos = np.zeros(total, np.intp), np.full(total, -np.inf, np.float32)
    rows = max(1, _BLOCK // total)
    for start in range(0, count, rows):
        cosine = descriptors[start : start + rows] @ landmarks.T
        here = np.arange(len(cosine))
        nearest = cosine.argmax(axis=1)
        column = cosine.argmax(axis=0)
        value = cosine[column, np.arange(total)]
        better = value > back_cos
        back[better], back_cos[better] = column[better] + start, value[better]
        best[start + here], best_cos[start + here] = nearest, cosine[here, nearest]
        cosine[here, nearest] = -np.inf
        second_cos[start + here] = cosine.max(axis=1)
    d1, d2 = (np.sqrt(np.maximum(2 - 2 * c, 0)) for c in (best_cos, second_cos))
    feature = np.flatnonzero((back[best] == np.arange(count)) & (d1 < max_ratio * d2))
    return feature, best[feature]


def spread(pixel_px: npt.ArrayLike, camera: Camera) -> float:
    """RMS distance of pixels (N, 2) from their centre, over the image's diagonal; 0 when none."""
    pixels = np.asarray(pixel_px, dtype=np.float64)
    if not len(pixels):
        return 0.0
    offset = pixels - pixels.mean(axis=0)
    rms = np.sqrt((offset * offset).sum(axis=1).mean())
    return float(rms / np.hypot(camera.width_px, camera.height_px))


def relocalize(
    features: Features,
    normalized: Array,
    landmarks: Landmarks,
    camera: Camera,
    settings: RecoverySettings,
    seed: int,
) -> Relocalization | str:
    """The pose of a frame anywhere in the map, or the reason why there is none.

    `normalized` (F, 2) are the features undistorted, on the plane z = 1. Matches against every
    landmark, P3P in locally optimised RANSAC (`cv2.USAC_ACCURATE`), and a strict check of the
    inliers' number, share and spread over the image.
    """
    feature, landmark = match_all(features.descriptors, landmarks.descriptor, settings.max_ratio)
    if len(feature) < settings.min_inliers:
        return f"{len(feature)} matches with the whole map"
    pinhole_px = normalized[feature] * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    params = cv2.UsacParams()
    params.threshold = settings.max_reprojection_px
    params.maxIterations = settings.max_iterations
    params.confidence = 0.9999
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    params.loIterations = 10
    params.loSampleSize = 30
    try:
        found, _, rvec, tvec, inliers = cv2.solvePnPRansac(
            landmarks.position_m[landmark], pinhole_px, camera.matrix, None, params=params
        )
    except cv2.error:
        return "no pose explains the matches"
    if not found or inliers is None or not np.isfinite(np.r_[rvec.ravel(), tvec.ravel()]).all():
        return "no pose explains the matches"
    rows = inliers.ravel()
    if len(rows) < max(settings.min_inliers, settings.min_inlier_share * len(feature)):
        return f"{len(rows)} inliers of {len(feature)} matches with the whole map"
    if spread(features.keypoints_px[feature[rows]], camera) < settings.min_spread:
        return "the inliers lie in one corner of the image"
    wTc = poses.inverse(poses.pose(cv2.Rodrigues(rvec)[0], tvec.ravel()))
    return Relocalization(wTc, feature[rows], landmark[rows])
