"""COLMAP's cameras as ours, and ours as COLMAP's.

The half pixel between COLMAP's corner of the picture and our first pixel's centre goes here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import MODELS
from pi_firmware.wire import config

if TYPE_CHECKING:
    import pycolmap

HALF_PIXEL = 0.5

_ORDER = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""COLMAP's parameters; the lens is OpenCV's polynomial or its fisheye."""
_OURS = {"opencv5": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}
_RATIONAL = ("k4", "k5", "k6")
"""Of `FULL_OPENCV`, what our five-parameter lens does not have."""


def camera_of(theirs: pycolmap.Camera) -> Camera:
    """COLMAP's camera as ours; raises `CameraError` or `ConfigError` for what ours cannot be."""
    name = theirs.model.name
    if name not in _ORDER:
        raise CameraError(f"it has the model {name}; what can be taken over is {', '.join(_ORDER)}")
    given = dict(zip(_ORDER[name].split(), theirs.params, strict=True))
    fisheye = name == "OPENCV_FISHEYE"
    others = () if fisheye else _RATIONAL
    rational = {k: given.pop(k) for k in others if k in given}
    if any(rational.values()):
        numbers = ", ".join(f"{k} {value:.3g}" for k, value in rational.items())
        raise CameraError(f"{name} with {numbers}; only 0 can be taken over")
    if "f" in given:
        given["fx"] = given["fy"] = given.pop("f")
    model = "fisheye" if fisheye else "opencv5"
    lens = {k: given[k] for k in MODELS[model].NAMES if k in given}
    values = {
        "model": model,
        "width_px": theirs.width,
        "height_px": theirs.height,
        "fx_px": given["fx"],
        "fy_px": given["fy"],
        "cx_px": given["cx"] - HALF_PIXEL,
        "cy_px": given["cy"] - HALF_PIXEL,
    }
    return config.from_mapping(values | lens, Camera, where=name)


def described(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model that has our camera's lens, and its parameters; the readout has no place."""
    values = {
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px + HALF_PIXEL,
        "cy": camera.cy_px + HALF_PIXEL,
    } | dict(zip(camera.lens.NAMES, camera.distortion.tolist(), strict=True))
    model = "PINHOLE" if camera.is_pinhole else _OURS[camera.model]
    return model, [values.get(name, 0.0) for name in _ORDER[model].split()]
