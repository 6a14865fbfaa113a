"""A wall of texture with boards before it, seen by a small camera: pictures in next to no time."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.geometry.camera import Camera

CAMERA = Camera(width_px=320, height_px=240, fx_px=250.0, fy_px=250.0, cx_px=159.5, cy_px=119.5)
WALL_M, BOARDS_M = 6.0, 3.0


def texture(seed: int, size: int = 512) -> np.ndarray:
    """Grey blotches of several sizes (size, size), as float32."""
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size), np.float32)
    for cells, weight in ((16, 1.0), (48, 1.0), (128, 0.8)):
        coarse = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
        image += weight * cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    return 128 + 45 * image


class Place:
    """A wall 6 m ahead and, over its upper half, another 3 m ahead, which hides it."""

    def __init__(self, seed: int) -> None:
        self._wall, self._boards = texture(seed), texture(seed + 1000)

    def picture(self, x_m: float = 0.0, yaw_deg: float = 0.0, blur_px: int = 0) -> np.ndarray:
        """What is seen from x_m to the right, turned to the right (H, W); smeared along rows."""
        u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
        pixels = np.stack([u.ravel(), v.ravel()], 1).astype(float)
        rays = np.column_stack([CAMERA.undistort(pixels), np.ones(len(pixels))])
        a = np.radians(yaw_deg)
        rays = rays @ np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]).T
        depth = np.where(rays[:, 1] < 0, BOARDS_M, WALL_M)
        points = rays / rays[:, 2:] * depth[:, None]
        points[:, 0] += x_m
        # 100 pixels of texture a metre
        at = (points[:, :2] * 100 + 256).astype(np.float32).reshape(CAMERA.height_px, -1, 2)
        wall, boards = (
            cv2.remap(t, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            for t in (self._wall, self._boards)
        )
        image = np.where(depth.reshape(wall.shape) == BOARDS_M, boards, wall)
        if blur_px:
            image = cv2.blur(image, (blur_px, 1))
        return np.clip(image, 0, 255).astype(np.uint8)
