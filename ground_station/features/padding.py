"""Pictures of sizes that a network takes."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import U8


def padded(image: U8, multiple: int) -> U8:
    """The image (H, W), its last row and column repeated to the next multiples: no edge is added.

    The image itself where it has such a size.
    """
    height, width = image.shape
    below, right = -height % multiple, -width % multiple
    if not below and not right:
        return image
    bordered = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(bordered, np.uint8)
