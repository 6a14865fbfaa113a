"""The camera: OpenCV's five-parameter lens model on a pinhole, and its TOML file.

Pixels: the centre of the top-left pixel is (0, 0), as in OpenCV. Camera axes: x right, y down,
z forward.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.errors import CameraError
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A calibrated camera; `readout_s` is the rolling shutter's time from first row to last."""

    width_px: int = config.key(640, "image width", unit="px", low=16, high=16384)
    height_px: int = config.key(480, "image height", unit="px", low=16, high=16384)
    fx_px: float = config.key(501.58, "focal length, horizontal", unit="px", low=1, high=1e5)
    fy_px: float = config.key(505.57, "focal length, vertical", unit="px", low=1, high=1e5)
    cx_px: float = config.key(312.51, "principal point, horizontal", unit="px", low=-1e4, high=1e5)
    cy_px: float = config.key(241.21, "principal point, vertical", unit="px", low=-1e4, high=1e5)
    k1: float = config.key(0.0, "radial distortion", low=-100, high=100)
    k2: float = config.key(0.0, "radial distortion", low=-100, high=100)
    p1: float = config.key(0.0, "tangential distortion", low=-100, high=100)
    p2: float = config.key(0.0, "tangential distortion", low=-100, high=100)
    k3: float = config.key(0.0, "radial distortion", low=-100, high=100)
    readout_s: float = config.key(
        0.0, "rolling-shutter readout, 0: global", unit="s", low=0, high=1
    )
    model: str = config.key("opencv5", "lens model", choices=["opencv5"])

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise CameraError(f"camera: {name} must be a finite number, not {value}")

    @property
    def matrix(self) -> Array:
        """K, 3×3, pixels."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def distortion(self) -> Array:
        """k1, k2, p1, p2, k3."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def project(self, points_c: npt.ArrayLike) -> Array:
        """Points in camera coordinates (N, 3), metres, to distorted pixels (N, 2).

        Brown–Conrady model as in OpenCV's calib3d documentation. Points at or behind the camera
        (z <= 0) give NaN.
        """
        points = np.asarray(points_c, dtype=np.float64).reshape(-1, 3)
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        return self.distort(points[:, :2] / z[:, None])

    def distort(self, normalized: npt.ArrayLike) -> Array:
        """Undistorted coordinates on the plane z = 1 (N, 2) to distorted pixels (N, 2)."""
        xy = np.asarray(normalized, dtype=np.float64).reshape(-1, 2)
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([self.fx_px * xd + self.cx_px, self.fy_px * yd + self.cy_px], axis=1)

    def undistort(self, pixels: npt.ArrayLike) -> Array:
        """Distorted pixels (N, 2) to undistorted coordinates on the plane z = 1 (N, 2)."""
        import cv2  # a tenth of a second for a process that only passes the numbers on

        uv = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2))
        if len(uv) == 0:
            return np.empty((0, 2))
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
        xy = cv2.undistortPointsIter(
            uv, self.matrix, self.distortion, np.eye(3), np.eye(3), criteria
        )
        return np.asarray(xy, np.float64).reshape(-1, 2)

    def undistort_to_pinhole(self, pixels: npt.ArrayLike) -> Array:
        """Distorted pixels (N, 2) to the pixels a camera with the same K and no lens would see."""
        xy = self.undistort(pixels)
        return xy * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]

    def as_dict(self) -> dict[str, float | int | str]:
        """The camera as the keys of its file."""
        return asdict(self)


THESIS_CAMERA = Camera(k1=0.1673, k2=-0.2605, p1=-1.3e-5, p2=-0.00203, k3=0.0, readout_s=0.020)
"""Pi camera v2.1 at 640×480 as calibrated in the thesis; the readout time is the simulator's."""


_REQUIRED = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")


def load_camera(path: str | Path) -> Camera:
    """Reads a camera file; raises `CameraError` with one line naming the key and its range.

    Size, focal lengths and principal point must be there; lens and readout default to none.
    """
    try:
        document = config.read(path)
        missing = [name for name in _REQUIRED if name not in document]
        if missing:
            raise CameraError(f"{path}: the key '{missing[0]}' is missing")
        return config.from_mapping(document, Camera, where=str(path))
    except ConfigError as error:
        raise CameraError(str(error)) from None
