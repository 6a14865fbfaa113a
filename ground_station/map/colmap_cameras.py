"""COLMAP's cameras as ours, and ours as COLMAP's.

The half pixel between COLMAP's corner of the picture and our first pixel's centre goes here.
"""

from __future__ import annotations

from ground_station.errors import CameraError
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import MODELS
from ground_station.map.colmap_files import CameraEntry
from pi_firmware.wire import config

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


def camera_of(entry: CameraEntry) -> Camera:
    """COLMAP's camera as ours; raises `CameraError` or `ConfigError` for what ours cannot be."""
    given = dict(zip(_ORDER[entry.model].split(), entry.params, strict=True))
    fisheye = entry.model == "OPENCV_FISHEYE"
    others = () if fisheye else _RATIONAL
    rational = {name: given.pop(name) for name in others if name in given}
    if any(rational.values()):
        numbers = ", ".join(f"{name} {value:.3g}" for name, value in rational.items())
        raise CameraError(f"{entry.model} with {numbers}; only 0 can be taken over")
    if "f" in given:
        given["fx"] = given["fy"] = given.pop("f")
    model = "fisheye" if fisheye else "opencv5"
    lens = {name: given[name] for name in MODELS[model].NAMES if name in given}
    values = {
        "model": model,
        "width_px": entry.width,
        "height_px": entry.height,
        "fx_px": given["fx"],
        "fy_px": given["fy"],
        "cx_px": given["cx"] - HALF_PIXEL,
        "cy_px": given["cy"] - HALF_PIXEL,
    }
    return config.from_mapping(values | lens, Camera, where=entry.model)


def entry_of(camera: Camera) -> CameraEntry:
    """Our camera as COLMAP's, of the model that has its lens; the readout has no place there."""
    values = {
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px + HALF_PIXEL,
        "cy": camera.cy_px + HALF_PIXEL,
    } | dict(zip(camera.lens.NAMES, camera.distortion.tolist(), strict=True))
    model = "PINHOLE" if camera.is_pinhole else _OURS[camera.model]
    params = [values.get(name, 0.0) for name in _ORDER[model].split()]
    return CameraEntry(model, camera.width_px, camera.height_px, tuple(params))
