"""The one interface of all extractors: an image in, key points with unit descriptors out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ground_station.arrays import F32, U8, Bools
from ground_station.errors import GroundStationError


class FeatureError(GroundStationError):
    """An unknown extractor, or an image that it cannot take."""


@dataclass(frozen=True)
class Features:
    """N key points of one image.

    `keypoints_px` (N, 2) float32, distorted pixels, centre of the top-left pixel is (0, 0);
    `scores` (N,) float32, higher is better; `descriptors` (N, D) float32, unit L2 norm.
    """

    keypoints_px: F32
    scores: F32
    descriptors: F32

    def __len__(self) -> int:
        return len(self.keypoints_px)

    def where(self, keep: Bools) -> Features:
        """Those alone; `keep` (N,)."""
        if keep.all():
            return self
        return Features(self.keypoints_px[keep], self.scores[keep], self.descriptors[keep])


class Extractor(Protocol):
    """Key points and descriptors of an image. `name` and `sha256` are what a map remembers.

    `distance_scale`: how far apart the descriptors of one point in two views are, over RootSIFT's.
    """

    name: str
    sha256: str
    dimension: int
    distance_scale: float

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8."""
        ...


def check_image(image: U8) -> None:
    """Raises `FeatureError` unless the image is (H, W) uint8 and at least 16 pixels each way."""
    if image.ndim != 2 or image.dtype != np.uint8 or min(image.shape) < 16:
        raise FeatureError(
            f"features: a grey uint8 image of at least 16x16 is needed, not "
            f"{'x'.join(map(str, image.shape))} {image.dtype}"
        )
