"""Features of a network of layout `blobs`: the picture's own blobs, described by a network."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from ground_station.arrays import F32, U8
from ground_station.features import sampling
from ground_station.features.extractor import Features, check_image
from ground_station.features.learned import LearnedFeatures
from ground_station.features.padding import padded

NMS_PX = 2
THRESHOLD = 0.0

SIGMA_PX = 1.8
"""On made pairs of views the middle of what is good, 1.6 to 2.4: below it noise is found, above it
places blur."""
KERNEL_PX = 15
BORDER_PX = 8
"""Where the picture is mirrored, blobs are none."""
FLAT = 1e-9
"""Added to the trace: less than any picture of 255 steps makes."""
LEAST = 1e-5
"""Of the response: a tenth of what noise of one step makes."""
_MARGIN = 4
"""So many of the strongest a wanted one are judged by the network."""


def response(image: U8) -> F32:
    """How much of a blob each pixel of a picture (H, W) is the middle of (H, W), 0..1 a px².

    The harmonic mean of the two principal curvatures of the smoothed picture where both have one
    sign, else nought: it is high on what is round, dark or bright, and low along edges. Its maxima
    are found again to a fraction of a pixel. Of the measures on the Hessian (Lindeberg, "Image
    Matching Using Generalized Scale-Space Interest Points", JMIV 2015, section 3) this is the
    determinant over the trace, as Brown, Szeliski and Winder (CVPR 2005, eq. 2) take it for
    corners; here at one scale.
    """
    smooth = cv2.GaussianBlur(
        image.astype(np.float32) * np.float32(1 / 255), (KERNEL_PX, KERNEL_PX), SIGMA_PX
    )
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=1)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=1)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3, scale=0.25)
    determinant = cv2.subtract(cv2.multiply(xx, yy), cv2.multiply(xy, xy))
    trace = np.abs(cv2.add(xx, yy)) + np.float32(FLAT)
    return np.asarray(cv2.divide(np.maximum(determinant, 0), trace, scale=2), np.float32)


def strongest(values: F32, radius_px: int, most: int) -> tuple[F32, F32]:
    """Places (N, 2), x then y, px, and heights (N,) of the highest maxima of a response (H, W).

    A maximum is the highest within `radius_px` along rows and columns; its place is that of the
    parabola through it and its eight neighbours (Brown and Lowe, BMVC 2002, eq. 3).
    """
    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    inner = values[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    top = cv2.dilate(values, window)[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    rows, columns = np.nonzero((inner == top) & (inner > LEAST))
    if len(rows) > most:
        heights = inner[rows, columns]
        kept = np.sort(np.argpartition(-heights, most)[:most])
        rows, columns = rows[kept], columns[kept]
    rows, columns = rows + BORDER_PX, columns + BORDER_PX
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
    """Key points are maxima of `response`; a network says how they look and which are worth it.

    A point's score is the chance that another view has it, too, and finds it by its descriptor: the
    logistic of ln(response) + `worth`. Its descriptor is `descriptors`, interpolated between
    centres of 8x8 pixels, before `details`, between those of 4x4, at unit length together.
    """

    NMS_PX, THRESHOLD = NMS_PX, THRESHOLD

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        check_image(image)
        points, heights = strongest(response(image), self.nms_px, _MARGIN * self.max_features)
        whole = padded(image, self._info.multiple).astype(np.float32)[None, None]
        outputs = self._network.run(whole * np.float32(1 / 255))
        return self.of_outputs(points, heights, {name: out[0] for name, out in outputs.items()})

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
        vectors, good = sampling.unit(np.concatenate(both, axis=1))
        order = order[good]
        return Features(points_px[order], scores[order], vectors[good])
