"""Pictures of a board as a camera takes them: lens, rolling shutter, motion blur, noise; no scene.

Every row sees the board from where the camera is at that row's time: a plane and a pose make a
homography, rows by rows, and the board's picture is looked up through it. Each pixel is averaged
over its own area and over the exposure. Time 0 of a frame is the middle of its middle row's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, U8
from ground_station.calibration.board import Board
from ground_station.geometry.camera import Camera

_TEXELS = 48
"""Of a square's side: a multiple of a marker's bits, so that all bits are alike."""
_JITTER = np.array([(-0.25, -0.25), (0.25, 0.25), (0.25, -0.25), (-0.25, 0.25)])


@dataclass(frozen=True)
class Pictured:
    """What the sensor adds: levels of 255, a blur in pixels."""

    white: float = 215.0
    black: float = 25.0
    around: float = 110.0
    lens_blur_px: float = 0.6
    noise: float = 2.5
    margin_squares: float = 0.5


class Waypoints:
    """A board carried from pose to pose: it rests, then moves with the least jerk (Flash and
    Hogan 1985). `poses` (K, 6) are rotation vectors and translations of the board in the camera."""

    def __init__(self, poses: F64, rest_s: float = 0.2, move_s: float = 0.7) -> None:
        self.poses, self.rest_s, self.move_s = poses, rest_s, move_s

    @property
    def duration_s(self) -> float:
        return len(self.poses) * self.rest_s + (len(self.poses) - 1) * self.move_s

    def at(self, time_s: F64) -> F64:
        """Poses (N, 6) at N times."""
        t = np.clip(np.asarray(time_s, np.float64), 0, self.duration_s - 1e-9)
        k = np.minimum((t // (self.rest_s + self.move_s)).astype(int), len(self.poses) - 1)
        s = np.clip((t - k * (self.rest_s + self.move_s) - self.rest_s) / self.move_s, 0, 1)
        s = s**3 * (10 - 15 * s + 6 * s**2)
        after = np.minimum(k + 1, len(self.poses) - 1)
        return self.poses[k] + s[:, None] * (self.poses[after] - self.poses[k])


def pose_of(
    camera: Camera, board: Board, centre_px: tuple[float, float], distance_m: float,
    tilt_deg: tuple[float, float] = (0.0, 0.0), roll_deg: float = 0.0,
) -> F64:  # fmt: skip
    """The pose (6,) that puts the board's middle there; tilts are about the picture's axes."""
    tilt = Rotation.from_rotvec(np.radians([tilt_deg[0], tilt_deg[1], 0.0]))
    turn = tilt * Rotation.from_euler("z", roll_deg, degrees=True)
    ray = np.append(camera.undistort([centre_px])[0], 1.0)
    middle = np.array([board.columns, board.rows, 0]) * board.square_mm / 2000
    return np.concatenate([turn.as_rotvec(), ray * distance_m - turn.apply(middle)])


def carried(
    camera: Camera, board: Board, rng: np.random.Generator, count: int, *,
    least: float = 0.55, most: float = 1.1, tilt_deg: float = 40.0, **times: float,
) -> Waypoints:  # fmt: skip
    """A board carried through all of the picture, near and far, tilted all ways.

    It fills `least` to `most` of the picture's width.
    """
    width_m = board.columns * board.square_mm / 1000
    filled = camera.fx_px * width_m / camera.width_px  # fills the picture's width there
    poses = []
    places = [(0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8), (0.5, 0.5), (0.35, 0.6), (0.65, 0.4)]
    for k in range(count):
        u, v = np.array(places[k % len(places)]) + rng.uniform(-0.06, 0.06, 2)
        direction, size = rng.uniform(0, 2 * math.pi), rng.uniform(0.3, 1.0) * tilt_deg
        poses.append(
            pose_of(
                camera, board, (u * camera.width_px, v * camera.height_px),
                filled / rng.uniform(least, most),
                (size * math.cos(direction), size * math.sin(direction)), rng.uniform(-25, 25),
            )
        )  # fmt: skip
    return Waypoints(np.array(poses), **times)


class BoardCamera:
    """Takes pictures of one board with one camera."""

    def __init__(self, camera: Camera, board: Board, look: Pictured | None = None) -> None:
        self.camera, self.look = camera, look or Pictured()
        w, h = camera.width_px, camera.height_px
        grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 2)
        rays = camera.undistort(grid).reshape(h, w, 2).astype(np.float32)
        self._x, self._y = rays[..., 0].copy(), rays[..., 1].copy()
        look = self.look
        drawn = board.charuco().generateImage(
            (board.columns * _TEXELS, board.rows * _TEXELS), marginSize=0
        )
        levels = np.where(drawn < 128, look.black, look.white).astype(np.float32)
        self._pad = round(look.margin_squares * _TEXELS) + 1
        inner = self._pad - 1
        levels = cv2.copyMakeBorder(
            levels, inner, inner, inner, inner, cv2.BORDER_CONSTANT, value=look.white
        )
        self._texture = cv2.copyMakeBorder(
            levels, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=look.around
        )
        self._per_m = _TEXELS * 1000 / board.square_mm
        self._row_s = (np.arange(h) / (h - 1) - 0.5) * camera.readout_s
        r2 = self._x**2 + self._y**2
        self._vignette = 1 - np.float32(0.15) * r2 / r2.max()

    def take(
        self, motion: Waypoints, time_s: float, exposure_s: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> U8:  # fmt: skip
        """A picture (H, W); without `rng` it has no noise.

        Of four samples of each pixel, each lies in another quarter of it and of the exposure.
        """
        total = np.zeros(self._x.shape, np.float32)
        for quarter, (du, dv) in enumerate(_JITTER):
            offset = ((quarter + 0.5) / len(_JITTER) - 0.5) * exposure_s
            poses = motion.at(time_s + offset + self._row_s)
            columns = Rotation.from_rotvec(poses[:, :3]).as_matrix()
            columns[:, :, 2] = poses[:, 3:]  # of the plane z = 0 only x and y count
            to_board = np.linalg.inv(columns).astype(np.float32)[:, :, :, None]
            x = self._x + np.float32(du / self.camera.fx_px)
            y = self._y + np.float32(dv / self.camera.fy_px)
            a, b, c = (
                to_board[:, i, 0] * x + to_board[:, i, 1] * y + to_board[:, i, 2] for i in range(3)
            )
            scale = np.float32(self._per_m) / c
            shift = np.float32(self._pad - 0.5)
            total += cv2.remap(
                self._texture, a * scale + shift, b * scale + shift, cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT, borderValue=self.look.around,
            )  # fmt: skip
        total /= len(_JITTER)
        total *= self._vignette
        if self.look.lens_blur_px > 0:
            total = cv2.GaussianBlur(total, (0, 0), self.look.lens_blur_px)
        if rng is not None:
            total += np.float32(self.look.noise) * rng.standard_normal(total.shape, np.float32)
        return np.clip(np.rint(total), 0, 255).astype(np.uint8)


def project_rolling(camera: Camera, points_m: F64, motion: Waypoints, time_s: float) -> F64:
    """Where N board points are seen (N, 2), each at its own row's time; outside or behind NaN."""
    px = np.full((len(points_m), 2), np.nan)
    row_s = np.zeros(len(points_m))
    for _ in range(8):
        poses = motion.at(time_s + row_s)
        turned = Rotation.from_rotvec(poses[:, :3]).apply(points_m) + poses[:, 3:]
        px = camera.project(turned)
        row_s = (np.nan_to_num(px[:, 1]) / (camera.height_px - 1) - 0.5) * camera.readout_s
    inside = (px >= 0).all(axis=1) & (px <= [camera.width_px - 1, camera.height_px - 1]).all(axis=1)
    px[~inside] = np.nan
    return px
