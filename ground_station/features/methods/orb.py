"""ORB: oriented FAST corners and rotated BRIEF. Rublee et al., ICCV 2011."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64, U8
from ground_station.features.extractor import Features, check_image

_SCALE, _LEVELS = 1.2, 8
_BITS = 256


class Orb:
    """OpenCV's ORB with 256 bits as unit vectors; dimension 256.

    A bit becomes +1/16 or -1/16, so each vector has unit length and the squared L2 distance of two
    is h / 64, where h is the number of bits in which they differ: the order by L2 is the order by
    Hamming distance, a ratio of L2 distances is the root of the ratio of Hamming distances, and
    a limit of 0.7 in L2 means 31 bits. Half of the right matches are farther than that, so where
    distances are scaled (the preset `default`) the limit is 1.2, or 92 bits.
    """

    name = "orb"
    dimension = _BITS
    distance_scale = 2.3

    def __init__(self, max_features: int = 1500) -> None:
        self.max_features = max_features
        self.sha256 = hashlib.sha256(b"orb/1 opencv-orb 256 bits 1.2 8 levels").hexdigest()
        self._orb = cv2.ORB.create(nfeatures=max_features, scaleFactor=_SCALE, nlevels=_LEVELS)

    def extract(self, image: U8) -> Features:
        """Features of a grey image (H, W) uint8, strongest first."""
        check_image(image)
        keypoints, bits = self._orb.detectAndCompute(image, None)
        if not keypoints or bits is None:
            empty = np.empty((0, 2), np.float32)
            return Features(empty, np.empty(0, np.float32), np.empty((0, _BITS), np.float32))
        positions = _centred(np.asarray(cv2.KeyPoint.convert(keypoints)), keypoints, image.shape)
        scores = np.array([keypoint.response for keypoint in keypoints], np.float32)
        order = np.argsort(-scores, kind="stable")[: self.max_features]
        return Features(
            positions[order].astype(np.float32),
            scores[order],
            unit_of_bits(np.asarray(bits, np.uint8)[order]),
        )


def _centred(
    corners_px: npt.NDArray[Any], keypoints: Sequence[cv2.KeyPoint], shape: tuple[int, ...]
) -> F64:
    """OpenCV's positions (N, 2) with the centre of the first pixel at (0, 0).

    It multiplies a level's pixel by the level's scale, which holds for the pixels' corners and
    for sizes that were not rounded: up to 1.4 px off at 640x480.
    """
    scale = _SCALE ** np.array([keypoint.octave for keypoint in keypoints])[:, None]
    full = np.array([shape[1], shape[0]])
    true_scale = full / np.round(full / scale)
    return (corners_px / scale + 0.5) * true_scale - 0.5


def unit_of_bits(bits: U8) -> F32:
    """Binary descriptors (N, B / 8) as unit vectors (N, B) of the two values ±1/√B."""
    signs = np.unpackbits(bits, axis=1).astype(np.float32) * 2 - 1
    return np.asarray(signs / np.sqrt(np.float32(signs.shape[1])), np.float32)


METHOD = Orb
