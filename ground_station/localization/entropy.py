"""How much a picture says: Shannon's entropy of its luma."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt


def entropy_bits(image: npt.NDArray[np.uint8]) -> float:
    """Shannon entropy of a grey image (H, W) uint8 over 256 levels, bits, 0 to 8.

    −Σ p log2 p; Shannon, Bell System Technical Journal 27, 1948.
    """
    counts = cv2.calcHist([image], [0], None, [256], [0.0, 256.0]).ravel().astype(np.float64)
    p = counts[counts > 0] / image.size
    return float(max(0.0, -np.sum(p * np.log2(p))))
