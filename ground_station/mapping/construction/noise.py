"""How exactly the key points of a build's own images fit one geometry, measured before they must.

Of neighbouring images the distances from the epipolar lines tell: the limit that makes the
agreement of all their matches least likely by chance is where noise ends and chance begins (a
contrario: Moulon, Monasse and Marlet, "Adaptive structure from motion with a contrario model
estimation", ACCV 2012). Images further apart show where a lens misfits, and get three times as
much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.geometry.epipolar import sampson_px
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.matching import essential, mutual_matches

_PAIRS, _GAPS = 48, (1, 2, 4)
"""Compared pairs of images at most, and how far apart they stand."""
_FEWEST = 40
"""Matches of a pair that is looked at."""
_LIMITS_PX = np.arange(0.5, 6.01, 0.25)
"""Tried, at a width of 640 pixels; a geometry is searched with two thirds of the largest."""
_APART = 3.0
"""How much further off than neighbours' the right matches of images far apart may lie. Plain COLMAP
has 4 px; by neighbours, RootSIFT's noise ends at 1.25 px in a real corridor and 1.0 in a kitchen,
ORB's there at 1.75, and RootSIFT's at 0.5 to 0.75 in simulated rooms."""
_MAD = 1.4826


@dataclass(frozen=True)
class Noise:
    """`sigma_px`: of a distance from an epipolar line; `limit_px`: how far off a right match is."""

    sigma_px: float
    limit_px: float


def matched_neighbours(images: Images, ratio: float, most: int) -> list[tuple[F64, F64]]:
    """Distorted key points (K, 2) each of pairs that stand near each other, all over the input."""
    count = len(images.names)
    pairs = [(i, i + gap) for gap in _GAPS for i in range(count - gap)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(most, len(pairs))).astype(np.int64))
    result = []
    for i, j in (pairs[k] for k in chosen.tolist()):
        first, second = images.features[i], images.features[j]
        matches = mutual_matches(first.descriptors, second.descriptors, ratio)
        if len(matches) >= _FEWEST:
            rows = first.keypoints_px[matches[:, 0]], second.keypoints_px[matches[:, 1]]
            result.append((rows[0].astype(np.float64), rows[1].astype(np.float64)))
    return result


def measured(images: Images, camera: Camera, ratio: float) -> Noise | None:
    """The noise of neighbours' matches, pixels of the picture; None where none overlap."""
    limits = _LIMITS_PX * camera.width_px / 640
    # A random match lies so near to a line, per pixel of distance: both sides of the longest.
    w, h = camera.width_px, camera.height_px
    chance = np.minimum(1.0, 2 * np.hypot(w, h) / (w * h) * 2 * limits)
    false_alarms = np.zeros(len(limits))
    inside: list[F64] = []
    for first, second in matched_neighbours(images, ratio, _PAIRS):
        p, q = camera.undistort_to_pinhole(first), camera.undistort_to_pinhole(second)
        found = essential(p, q, camera.matrix, float(limits[-1]) * 2 / 3, 0.9999, 1000)
        if found is None:
            continue
        distance = sampson_px(p, q, found[0], camera.matrix)
        distance /= np.sqrt(0.5 * (camera.stretch(p) ** 2 + camera.stretch(q) ** 2))
        n, k = len(distance), (distance[:, None] < limits).sum(axis=0)
        binomial = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
        false_alarms += binomial + k * np.log(chance)
        inside.append(distance[distance < limits[-1]])
    if not inside:
        return None
    limit = _APART * float(limits[np.argmin(false_alarms)])
    return Noise(_MAD * float(np.median(np.concatenate(inside))), limit)
