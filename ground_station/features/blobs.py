"""Features of a network of layout `blobs`: the picture's own blobs, described by a network."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from ground_station.arrays import F32, U8, Indices
from ground_station.features import sampling
from ground_station.features.extractor import Features
from ground_station.features.learned import LearnedFeatures, described

SIGMAS_PX = (1.6, 1.6 * 2**0.5, 3.2)
"""An octave of scales: of one alone the places shift as the camera comes nearer (of made pairs a
camera's step of 1.3 to 1.7 closer left 73 matches within half a pixel, of three 157), and of finer
or more of them those found again are fewer."""
_REACH = 3.0
"""Standard deviations of a kernel's half width."""
BORDER_PX = 8
"""Where the picture is mirrored, blobs are none."""
FLAT = 1e-9
"""Added to the trace, so that nothing is divided by nought."""
LEAST = 1e-5
"""Of the response: of the maxima that noise of one step makes nearly all are over three times it,
so that a flat picture has none and a faint one has all."""
_MARGIN = 4
"""So many of the strongest a wanted one are judged by the network."""


def kernel(level: int) -> F32:
    """The Gaussian (K,) that brings a picture to a level from the one before, or from none."""
    before = SIGMAS_PX[level - 1] if level else 0.0
    sigma = (SIGMAS_PX[level] ** 2 - before**2) ** 0.5
    reach = round(_REACH * sigma)
    values = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * sigma**2))
    return np.asarray(values / values.sum(), np.float32)


def responses(image: U8) -> F32:
    """How much of a blob each pixel of a picture (H, W) is the middle of, at each scale (L, H, W).

    The harmonic mean of the two principal curvatures of the smoothed picture, 0..1 a square as wide
    as the scale is over the finest, px, where both have one sign, else nought: it is high on what
    is round, dark or bright, and low along edges. Of the measures on the Hessian (Lindeberg,
    "Image Matching Using Generalized Scale-Space Interest Points", JMIV 2015, section 3) this is
    the determinant over the trace, as Brown, Szeliski and Winder (CVPR 2005, eq. 2) take it for
    corners.
    """
    # New arrays of this size are pages of their own: to touch each for the first time takes longer
    # than the arithmetic.
    smooth, other, xx, yy, xy = np.empty((5, *image.shape), np.float32)
    np.multiply(image, np.float32(1 / 255), out=smooth)
    made = np.empty((len(SIGMAS_PX), *image.shape), np.float32)
    for level, sigma in enumerate(SIGMAS_PX):
        row, response = kernel(level), made[level]
        cv2.sepFilter2D(smooth, cv2.CV_32F, row, row, dst=other)
        smooth, other = other, smooth
        cv2.Sobel(smooth, cv2.CV_32F, 2, 0, dst=xx, ksize=1)
        cv2.Sobel(smooth, cv2.CV_32F, 0, 2, dst=yy, ksize=1)
        cv2.Sobel(smooth, cv2.CV_32F, 1, 1, dst=xy, ksize=3, scale=0.25)
        np.multiply(xx, yy, out=response)
        response -= np.multiply(xy, xy, out=xy)
        np.maximum(response, 0, out=response)
        np.abs(np.add(xx, yy, out=xx), out=xx)
        xx += np.float32(FLAT)
        cv2.divide(response, xx, dst=response, scale=2 * (sigma / SIGMAS_PX[0]) ** 2)
    return made


def strongest(levels: F32, radius_px: int, most: int) -> tuple[F32, F32]:
    """Places (N, 2), x then y, px, and heights (N,) of the highest maxima of responses (L, H, W).

    A maximum is the highest within `radius_px` along rows and columns, and within one pixel at the
    scales beside its own; its place is that of the parabola through it and its eight neighbours
    (Brown and Lowe, BMVC 2002, eq. 3, in two dimensions). Of `most` some are none, and left out.
    """
    inner = np.s_[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    beside = [cv2.dilate(values, np.ones((3, 3), np.uint8))[inner] for values in levels]
    found, heights = [], []
    for level, values in enumerate(levels):
        own = values[inner]
        peak = own >= np.maximum(cv2.dilate(values, window)[inner], np.float32(LEAST))
        if level:
            peak &= own > beside[level - 1]
        if level + 1 < len(levels):
            peak &= own >= beside[level + 1]
        flat = np.flatnonzero(peak)
        rows, columns = np.divmod(flat, own.shape[1])
        rows, columns = rows + BORDER_PX, columns + BORDER_PX
        found.append((rows, columns))
        heights.append(values[rows, columns])
    least = _nth(np.concatenate(heights), most)
    placed = [
        _placed(values, rows[high >= least], columns[high >= least])
        for values, (rows, columns), high in zip(levels, found, heights, strict=True)
    ]
    places, high = (np.concatenate(parts) for parts in zip(*placed, strict=True))
    return places, high


def _nth(heights: F32, most: int) -> float:
    """What the `most` highest of them are at least."""
    if len(heights) <= most:
        return 0.0
    return float(np.partition(heights, len(heights) - most)[len(heights) - most])


def _placed(values: F32, rows: Indices, columns: Indices) -> tuple[F32, F32]:
    """Places and heights of the maxima at pixels (N,) that are any."""
    around = {(dx, dy): values[rows + dy, columns + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)}
    c = around[0, 0]
    xx, yy = around[-1, 0] + around[1, 0] - 2 * c, around[0, -1] + around[0, 1] - 2 * c
    xy = (around[-1, -1] + around[1, 1] - around[1, -1] - around[-1, 1]) / 4
    x, y = (around[1, 0] - around[-1, 0]) / 2, (around[0, 1] - around[0, -1]) / 2
    bent = np.maximum(xx * yy - xy * xy, np.float32(1e-12))
    moved = np.stack([xy * y - yy * x, xy * x - xx * y], axis=1) / bent[:, None]
    good = (np.abs(moved) < 1).all(axis=1)
    for before in ((-1, -1), (0, -1), (1, -1), (-1, 0)):  # of equal neighbours the first
        good &= c > around[before]
    places = np.stack([columns, rows], axis=1) + moved
    return places[good].astype(np.float32), c[good]


class BlobFeatures(LearnedFeatures):
    """Key points are maxima of `responses`; a network says how they look and which are worth it.

    A point's score is the chance that another view has it, too, and finds it by its descriptor: the
    logistic of ln(response) + `worth`. Its descriptor is `descriptors`, interpolated between
    centres of 8x8 pixels, before `details`, between those of 4x4, at unit length together.
    """

    NMS_PX, THRESHOLD = 2, 0.0

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        outputs = self._outputs(image)
        points, heights = strongest(responses(image), self.nms_px, _MARGIN * self.max_features)
        return self.of_outputs(points, heights, outputs)

    def of_outputs(self, points_px: F32, heights: F32, outputs: Mapping[str, F32]) -> Features:
        """Features at blobs (N, 2) of heights (N,) from what the network said of their picture."""
        eighth = (points_px - np.float32(3.5)) / np.float32(8)
        quarter = (points_px - np.float32(1.5)) / np.float32(4)
        worth = sampling.bilinear(outputs["worth"], eighth)[:, 0]
        with np.errstate(over="ignore"):
            scores = np.asarray(1 / (1 + np.exp(-worth) / heights), np.float32)
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > self.threshold][: self.max_features]  # nor NaN
        both = (sampling.bicubic(outputs["descriptors"], eighth[order]),
                sampling.bicubic(outputs["details"], quarter[order]))  # fmt: skip
        return described(points_px[order], scores[order], np.concatenate(both, axis=1))
