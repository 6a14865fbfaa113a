"""Which frames are not worth solving: those that say too little, and those that show nothing.

Of 498 frames of four simulated flights (noon and sunset) and of a hand-held camera in a kitchen
none had a contrast below 159 grey levels; black with a sensor's noise (standard deviation 3) has 3.
"""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.arrays import U8
from ground_station.localization.settings import GateSettings
from pi_firmware.wire.entropy import of_counts

_BLOCK_PX = 8


def entropy_bits(image: U8) -> float:
    """Shannon's entropy of a picture (H, W), as the payload measures it, in less time."""
    return of_counts(cv2.calcHist([image], [0], None, [256], [0, 256]).ravel().astype(np.int64))


def contrast(image: U8) -> float:
    """The brightest less the darkest block of 8x8 px of a picture (H, W), grey levels.

    A block's mean has an eighth of the sensor's noise, and one small dark thing on a white wall
    still has a block of its own.
    """
    height, width = image.shape
    size = max(1, width // _BLOCK_PX), max(1, height // _BLOCK_PX)
    return float(np.ptp(cv2.resize(image, size, interpolation=cv2.INTER_AREA)))


def low_entropy(entropy: float, settings: GateSettings) -> str:
    """Why a picture of that entropy, bits, is skipped; empty when it is not."""
    if entropy >= settings.min_entropy_bits:
        return ""
    return f"entropy {entropy:.2f} below {settings.min_entropy_bits:g} bits"


def low_contrast(image: U8, settings: GateSettings) -> str:
    """Why nothing can be seen in a grey picture (H, W); empty when something can."""
    if settings.min_contrast <= 0 or (shown := contrast(image)) >= settings.min_contrast:
        return ""
    return f"contrast {shown:.0f} below {settings.min_contrast:g} grey levels"
