"""The camera: a lens model on a pinhole, and its TOML file.

Pixels: the centre of the top-left pixel is (0, 0), as in OpenCV. Camera axes: x right, y down,
z forward. What only a lens model knows is in `lens_models`; others ask the camera.

A fisheye's picture may show directions up to and beyond 90° from its axis, but poses and maps are
computed on the plane z = 1: up to `lens_models.WIDEST` from the axis key points are used, and what
lies beyond has no undistorted pixel (NaN). `rays` and `project` know all of the lens.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Bools
from ground_station.errors import CameraError
from ground_station.geometry.lens_models import MODELS, KannalaBrandt, LensModel
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

NEAREST_M = 0.05
"""Nearer than this a landmark has no useful projection."""


@dataclass(frozen=True)
class Camera:
    """A calibrated camera; `readout_s` is the rolling shutter's time from first row to last.

    `model` says which of the lens's numbers there are: k1, k2, p1, p2, k3 or, of a fisheye, k1 to
    k4. The others are 0.
    """

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
    model: str = config.key("opencv5", "lens model", choices=list(MODELS))
    k4: float = config.key(0.0, "radial distortion of a fisheye", low=-100, high=100)

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if isinstance(value, float) and not math.isfinite(value):
                raise CameraError(f"camera: {name} must be a finite number, not {value}")
        for name in foreign_keys(self.model):
            if getattr(self, name) != 0:
                raise CameraError(f"camera: {not_of(name, self.model)}")
        if isinstance(self.lens, KannalaBrandt):
            self._check_fold(self.lens)

    def _check_fold(self, lens: KannalaBrandt) -> None:
        """Refuses a polynomial that turns back inside of the picture, within the nearest border."""
        ends = (self.width_px - 1, self.height_px - 1)
        border = min(
            min(centre, end - centre) / focal
            for centre, end, focal in zip(
                (self.cx_px, self.cy_px), ends, (self.fx_px, self.fy_px), strict=True
            )
        )
        if lens.fold < math.pi and lens.radius(np.array(lens.fold)) < border:
            raise CameraError(
                f"camera: k1 to k4 turn the picture back {math.degrees(lens.fold):.0f}° from the "
                "axis, inside of it, which no fisheye does: are they another model's "
                "(model = 'opencv5'), or the focal length another picture size's?"
            )

    @cached_property
    def lens(self) -> LensModel:
        """The lens model with its numbers."""
        chosen = MODELS[self.model]
        return chosen(**{name: getattr(self, name) for name in chosen.NAMES})

    @cached_property
    def max_radius(self) -> float:
        """How far from the axis, on the plane z = 1, directions may land in the image.

        Farther out a distortion polynomial folds back, and directions that no pixel sees would land
        inside. Of a fisheye it is what is used.
        """
        w, h = self.width_px - 0.5, self.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [w, -0.5], [-0.5, h], [w, h]])
        farthest = 1.02 * float(np.linalg.norm(self.undistort(corners), axis=1).max())
        reach = self.lens.reach
        return farthest if farthest < reach else reach  # also where that is not a number

    def inside(self, normalized: F64) -> Bools:
        """Whether directions (N, 2) on the plane z = 1 land in the image; (N,)."""
        near = np.einsum("ij,ij->i", normalized, normalized) <= self.max_radius**2
        pixels = self.distort(normalized[near])
        last = [self.width_px - 0.5, self.height_px - 0.5]
        near[near] = ((pixels >= -0.5) & (pixels < last)).all(axis=1)
        return np.asarray(near)

    @property
    def matrix(self) -> F64:
        """K, 3×3, pixels."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def distortion(self) -> F64:
        """The lens's numbers in OpenCV's order: k1, k2, p1, p2, k3, or a fisheye's k1 to k4."""
        return np.array([getattr(self, name) for name in self.lens.NAMES])

    @property
    def distortion_model(self) -> str:
        """Its name in `foxglove.CameraCalibration`."""
        return self.lens.FOXGLOVE

    @property
    def is_pinhole(self) -> bool:
        """Whether its pictures are undistorted as they are."""
        return self.lens.is_none

    def project(self, points_c: npt.ArrayLike) -> F64:
        """Points in camera coordinates (N, 3), metres, to distorted pixels (N, 2).

        NaN for points that the lens does not see: at or behind the camera (z <= 0), and of a
        fisheye those farther from the axis than where its polynomial turns back.
        """
        return self._pixels(self.lens.bend_points(np.asarray(points_c, np.float64).reshape(-1, 3)))

    def distort(self, normalized: npt.ArrayLike) -> F64:
        """Undistorted coordinates on the plane z = 1 (N, 2) to distorted pixels (N, 2)."""
        return self._pixels(self.lens.bend(np.asarray(normalized, np.float64).reshape(-1, 2)))

    def _pixels(self, bent: F64) -> F64:
        x, y = bent[:, 0], bent[:, 1]
        return np.stack([self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px], axis=1)

    def undistort(self, pixels: npt.ArrayLike) -> F64:
        """Distorted pixels (N, 2) to undistorted coordinates on the plane z = 1 (N, 2).

        NaN for pixels of a fisheye that are not used: see `uses`.
        """
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        return self.lens.unbend(uv, self.matrix) if len(uv) else np.empty((0, 2))

    def undistort_to_pinhole(self, pixels: npt.ArrayLike) -> F64:
        """Distorted pixels (N, 2) to the pixels a camera with the same K and no lens would see."""
        xy = self.undistort(pixels)
        return xy * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]

    def rays(self, pixels: npt.ArrayLike) -> F64:
        """Distorted pixels (N, 2) to directions in camera coordinates (N, 3), not of length 1.

        Those of a fisheye may point behind the plane z = 1; NaN where it sees nothing.
        """
        return self.lens.rays(np.asarray(pixels, np.float64).reshape(-1, 2), self.matrix)

    def uses(self, pixels: npt.ArrayLike) -> Bools:
        """Whether distorted pixels (N, 2) are near enough to the axis to be used (N,)."""
        return self.lens.uses(np.asarray(pixels, np.float64).reshape(-1, 2), self.matrix)

    def drawn_in(self, pixels: npt.ArrayLike) -> F64:
        """Distorted pixels (N, 2) that are not used drawn to the axis until they are (N, 2)."""
        bent = self.lens.drawn_in((np.asarray(pixels, np.float64) - [self.cx_px, self.cy_px])
                                  / [self.fx_px, self.fy_px])  # fmt: skip
        return self._pixels(bent)

    def stretch(self, pinhole_px: npt.ArrayLike) -> F64:
        """By how much a pixel's noise is longer at undistorted pixels (N, 2): (N,)."""
        pixels = np.asarray(pinhole_px, np.float64).reshape(-1, 2)
        return self.lens.stretch((pixels - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px])

    def rows(self, pinhole_px: F64) -> F64:
        """About which row of the picture (N,) undistorted pixels (N, 2) are in.

        The five-parameter lens is not looked at, as it moves rows by a few.
        """
        if isinstance(self.lens, KannalaBrandt):
            flat = (pinhole_px - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
            return np.asarray(self.distort(flat)[:, 1])
        return np.asarray(pinhole_px[:, 1])

    def as_dict(self) -> dict[str, float | int | str]:
        """The camera as the keys of its file: those of its model."""
        foreign = foreign_keys(self.model)
        return {name: value for name, value in asdict(self).items() if name not in foreign}

    def as_page(self) -> dict[str, Any]:
        """The camera as pages are told it, for JSON: size, `K` (3, 3), lens numbers and model."""
        return {
            "width_px": self.width_px,
            "height_px": self.height_px,
            "K": self.matrix.tolist(),
            "distortion": self.distortion.tolist(),
            "model": self.model,
        }


def foreign_keys(model: str) -> list[str]:
    """The lens numbers that are of another model."""
    every = dict.fromkeys(name for kind in MODELS.values() for name in kind.NAMES)
    return [name for name in every if name not in MODELS[model].NAMES]


def not_of(name: str, model: str) -> str:
    """What to say of a key that is of another lens model."""
    other = next(other for other, kind in MODELS.items() if name in kind.NAMES)
    known = ", ".join(MODELS[model].NAMES)
    return f"{name} is of model = '{other}'; '{model}' has {known}: remove {name}, or change model"


THESIS_CAMERA = Camera(k1=0.1673, k2=-0.2605, p1=-1.3e-5, p2=-0.00203, k3=0.0, readout_s=0.020)
"""Pi camera v2.1 at 640×480 as calibrated in the thesis; the readout time is the simulator's."""


_MADE_BY = "blimp calibrate makes a camera file"
_REQUIRED = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")


def load_camera(path: str | Path) -> Camera:
    """Reads a camera file; raises `CameraError` with one line naming the key and its range.

    Size, focal lengths and principal point must be there; lens and readout default to none.
    """
    try:
        document = config.read(path)
    except ConfigError as error:
        raise CameraError(f"{error}; {_MADE_BY}") from None
    try:
        missing = [name for name in _REQUIRED if name not in document]
        if missing:
            raise CameraError(f"the key '{missing[0]}' is missing; {_MADE_BY}")
        model = document.get("model", Camera.model)
        for name in foreign_keys(model) if model in list(MODELS) else ():
            if name in document:  # even as 0: its writer thought of another lens
                raise CameraError(not_of(name, model))
        return config.from_mapping(document, Camera, where=str(path))
    except ConfigError as error:
        raise CameraError(str(error)) from None
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None
