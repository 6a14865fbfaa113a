"""Smaller pictures."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ground_station.arrays import U8
from ground_station.experiments.disturbance import Disturbance
from ground_station.geometry.camera import Camera
from ground_station.geometry.resizing import scaled
from pi_firmware.wire import config


@dataclass(frozen=True)
class Scale(Disturbance):
    """Fewer pixels of the same view, at least 16 a side."""

    scale: float = config.key(1.0, "side of the picture over the flight's", low=0.1, high=1.0)

    def picture(self, image: U8, time_s: float) -> U8:
        size = self._size(image.shape[1], image.shape[0])
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def camera(self, camera: Camera) -> Camera:
        return scaled(camera, *self._size(camera.width_px, camera.height_px))

    def _size(self, width_px: int, height_px: int) -> tuple[int, int]:
        return max(16, round(width_px * self.scale)), max(16, round(height_px * self.scale))


DISTURBANCE = Scale
