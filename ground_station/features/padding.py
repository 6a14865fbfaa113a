"""Pictures of sizes that a network takes."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt


def padded(image: npt.NDArray[np.uint8], multiple: int) -> npt.NDArray[np.uint8]:
    """The image (H, W), its last row and column repeated to the next multiples: no edge is added.

    The image itself where it has such a size.
    """
    height, width = image.shape
    below, right = -height % multiple, -width % multiple
    if not below and not right:
        return image
    bordered = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(bordered, np.uint8)
