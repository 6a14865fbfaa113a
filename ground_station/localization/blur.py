"""How far motion smears a landmark's image, and how much less surely it is then found.

Measured on simulated flights of 3 to 4 m/s (fast-noon-103 and another of that plan, seed 5; true
poses, RootSIFT against the map's landmarks, 61,000 pairs): standard deviation of a feature along
and across its path, px, by median absolute deviation, the landmarks' own error included.

    expected blur   0.3    0.8    1.5    2.4    3.4    4.9    6.9    9.0
    along, 103      0.79   0.78   0.72   0.78   0.92   1.05   1.41   1.61
    across, 103     0.75   0.71   0.69   0.74   1.01   0.93   0.92   1.06
    along, 5        1.24   1.15   0.91   0.94   1.03   1.22   1.44   2.14
    across, 5       1.04   0.90   0.98   0.96   0.85   0.99   0.97   1.11

What is added in quadrature is 0.16 of the blur along and 0.06 across: 0.12 of a coordinate. Points
followed by KLT grow alike over 6 frames, and less over 3. At the same expected blur a frame of less
gradient energy was not worse, down to 0.65 of its neighbours' amplitude: energy says something only
beyond.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, U8
from ground_station.geometry.camera import Camera
from ground_station.localization.settings import BlurSettings

_REDUCTION = 2
"""Averaged over as many pixels each way, noise falls and blur of a few pixels is still seen."""

_LEAST_CONTRAST = 1.0
"""Variance, grey levels squared, below which a picture is noise and rounding."""

_LEAST_SHARPNESS = 0.05

_BLUR_OF_ENERGY_PX = 12.0
"""Pixels of blur for each 1 that the inverse of relative energy rises.

Frames of fast-noon-103 and the sample's flight smeared by 4, 8, 12, 20 and 30 px along the rows
kept 0.72, 0.58, 0.51, 0.41 and 0.35 of their energy.
"""


def expected_blur_px(
    camera: Camera, points_c: npt.ArrayLike, twist: npt.ArrayLike, exposure_s: float | None
) -> F64:
    """The length (N,) of the path of points in the (distorted) image during an exposure, px.

    `points_c` (N, 3), metres, in the camera's axes at the middle of the exposure; `twist` (6,), the
    camera's in its own axes, rotation (rad/s) before translation (m/s). Zeros where the exposure is
    not known; NaN for a point that is or comes behind the camera.
    """
    points = np.asarray(points_c, np.float64).reshape(-1, 3)
    if exposure_s is None:
        return np.zeros(len(points))
    w, v = np.asarray(twist, np.float64).reshape(2, 3)
    half = (np.cross(w, points) + v) * (exposure_s / 2)
    before, middle, after = (camera.project(points + k * half) for k in (1, 0, -1))
    first = np.linalg.norm(middle - before, axis=1)
    return np.asarray(first + np.linalg.norm(after - middle, axis=1))


def gradient_energy(image: U8) -> float:
    """The mean squared gradient over the variance of a grey image (H, W) uint8, at half its size.

    Free of brightness and exposure; 0 for a picture without contrast. Blur lowers it.
    """
    height, width = image.shape
    if min(height, width) < 2 * _REDUCTION:
        return 0.0
    size = (width // _REDUCTION, height // _REDUCTION)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    variance = float(cv2.meanStdDev(small)[1].item()) ** 2
    if variance < _LEAST_CONTRAST:
        return 0.0
    here = small[:-1, :-1]
    squares = sum(
        cv2.norm(there, here, cv2.NORM_L2SQR) for there in (small[:-1, 1:], small[1:, :-1])
    )
    return squares / (here.size * variance)


def sharpness(energy: float, recent: Sequence[float]) -> float:
    """A frame's gradient amplitude over the median of recent frames', above 0 and at most 1.

    `energy` and `recent` are of `gradient_energy`. 1 where nothing recent is known.
    """
    known = np.asarray(recent, np.float64)
    known = known[np.isfinite(known) & (known > 0)]
    if not len(known) or not np.isfinite(energy):
        return 1.0
    amplitude = np.sqrt(max(energy, 0.0) / float(np.median(known)))
    return float(np.clip(amplitude, _LEAST_SHARPNESS, 1.0))


def blurred_sigma_px(
    sigma_px: npt.ArrayLike,
    blur_px: npt.ArrayLike,
    sharpness: float = 1.0,
    settings: BlurSettings | None = None,
) -> F64:
    """Standard deviations (N,) of N features' coordinates in a blurred frame, px.

    `sigma_px` (N,) or one for all, what they are without blur; `blur_px` (N,) as expected, NaN
    where not known. A frame less sharp than its scene's changes explain is taken to be blurred by
    as much as that needs, where that is more: its exposure may be unknown, or its lens unfocused.
    """
    settings = settings or BlurSettings()
    blur = np.nan_to_num(np.asarray(blur_px, np.float64), nan=0.0)
    share = max(sharpness, _LEAST_SHARPNESS) if np.isfinite(sharpness) else 1.0
    unexplained = max(0.0, 1 / share**2 - 1 / settings.plain_sharpness**2)
    blur = np.maximum(blur, _BLUR_OF_ENERGY_PX * unexplained)
    return np.asarray(np.hypot(sigma_px, settings.sigma_per_px * blur))
