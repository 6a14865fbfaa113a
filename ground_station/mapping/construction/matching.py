"""Matches between two images and their verification by two-view geometry."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import F32, F64, I32, Bools
from ground_station.mapping.settings import MatchSettings
from ground_station.mapping.sfm.two_view import TwoView

_MIN_SAMPLE = 8
"""Fewer matches than this support any essential matrix."""
_CONFIDENCE = 0.9999
_MAX_ITERATIONS = 2000


def mutual_matches(first: F32, second: F32, ratio: float) -> I32:
    """Mutual nearest neighbours that pass the ratio test both ways, as index pairs (K, 2).

    `first` (N, D) and `second` (M, D) are unit descriptors; `ratio` bounds the nearest distance
    over the second nearest (Lowe, IJCV 2004, section 7.1), in the first image's list and in the
    second's.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), np.int32)
    # Of unit vectors ‖a − b‖² = 2 − 2 a·b, so one matrix product gives all distances.
    similarity = first @ second.T
    rows = np.arange(len(first))
    best = similarity.argmax(axis=1)
    value = similarity[rows, best]
    column_best = similarity.max(axis=0)
    similarity[rows, best] = -2.0
    runner_up = similarity.max(axis=1)
    square = np.float32(ratio * ratio)
    good = (value >= column_best[best]) & (1 - value < square * (1 - runner_up))
    i = np.flatnonzero(good)
    if not len(i):
        return np.empty((0, 2), np.int32)
    j, value = best[i], value[i]
    # The best of column j is row i itself, blanked above; another row whose best was j, too, was
    # blanked with it, so it is compared on its own.
    others = np.full(len(second), -2.0, np.float32)
    losers = np.flatnonzero(~good)
    np.maximum.at(others, best[losers], (first[losers] * second[best[losers]]).sum(axis=1))
    column_runner_up = np.maximum(similarity[:, j].max(axis=0), others[j])
    keep = 1 - value < square * (1 - column_runner_up)
    return np.stack([i[keep], j[keep]], axis=1).astype(np.int32)


def essential(
    p: F64, q: F64, camera_matrix: F64, error_px: float, confidence: float, iterations: int
) -> tuple[F64, Bools] | None:
    """The essential matrix (3, 3) that most matched pixels (K, 2) agree with, and which do (K,).

    None where there is none, as where a sample is degenerate.
    """
    try:
        E, mask = cv2.findEssentialMat(
            p, q, camera_matrix, cv2.USAC_MAGSAC, confidence, error_px, iterations
        )
    except cv2.error:
        return None
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    return np.asarray(E, np.float64), mask.ravel() != 0


def verify(
    first_px: F64,
    second_px: F64,
    matches: I32,
    camera_matrix: F64,
    rules: MatchSettings,
) -> TwoView | None:
    """The two-view geometry that most matches agree with, or None when it is none by the rules.

    `first_px` (N, 2) and `second_px` (M, 2) are undistorted pixels, `matches` (K, 2) indices into
    them, `camera_matrix` (3, 3). MAGSAC++ (Barath et al., CVPR 2020) finds the essential matrix; a
    homography that explains at least `planar_ratio` of its inliers makes the pair degenerate, and
    then the homography's inliers are the ones to trust, because a free baseline lets anything on
    its epipolar lines pass.
    """
    if len(matches) < _MIN_SAMPLE:
        return None
    p, q, error_px = first_px[matches[:, 0]], second_px[matches[:, 1]], rules.error_px
    found = essential(p, q, camera_matrix, error_px, _CONFIDENCE, _MAX_ITERATIONS)
    if found is None:
        return None
    E, inliers = found
    try:
        H, planar = cv2.findHomography(
            p, q, cv2.USAC_MAGSAC, 2 * error_px, None, _MAX_ITERATIONS, _CONFIDENCE
        )
    except cv2.error:  # the solver found no model in a degenerate sample
        return None
    degenerate = False
    if H is not None and planar is not None:
        on_plane = planar.ravel() != 0
        degenerate = bool(on_plane.sum() >= rules.planar_ratio * inliers.sum())
        if degenerate:
            inliers = on_plane
    # Repeated patterns look alike without sharing a geometry.
    fewest = max(rules.min_inliers, rules.min_inlier_ratio * len(matches))
    if inliers.sum() < fewest:
        return None
    homography = None if H is None else np.asarray(H, np.float64)
    return TwoView(matches[inliers], E, homography, degenerate)
