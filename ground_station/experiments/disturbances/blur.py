"""A lens out of focus."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ground_station.arrays import U8
from ground_station.experiments.disturbance import Disturbance
from pi_firmware.wire import config


@dataclass(frozen=True)
class Blur(Disturbance):
    """The same blur over the whole picture."""

    blur_px: float = config.key(
        0.0, "standard deviation of a Gaussian blur", unit="px", low=0.0, high=50.0
    )

    def picture(self, image: U8, time_s: float) -> U8:
        if self.blur_px == 0:
            return image
        return np.asarray(cv2.GaussianBlur(image, (0, 0), self.blur_px), np.uint8)


DISTURBANCE = Blur
