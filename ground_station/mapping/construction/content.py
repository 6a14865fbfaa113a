"""What a build knows its parts by: hashes of exactly what each is made from.

A part that has been made is found again by its hash, under whatever name its image came; a setting
that changes leads to new hashes of what it touches, and of nothing else.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Any

import cv2

from ground_station.arrays import U8
from ground_station.features.extractor import Extractor
from ground_station.geometry.camera import Camera
from ground_station.mapping.settings import MappingSettings

_FEATURES, _PAIR = b"blimp features 2\n", b"blimp pair 1\n"
"""Counted on when the same input gives another result: what was made before is then made again."""


def extraction(extractor: Extractor, settings: MappingSettings) -> bytes:
    """What, besides an image, decides which features come of it; one line for `features_key`."""
    document: dict[str, Any] = {
        "extractor": extractor.name,
        "sha256": extractor.sha256,
        "max_features": settings.max_features,
        "opencv": cv2.__version__,
    }
    if hasattr(extractor, "threshold"):  # a network's: methods have no such choice
        import onnxruntime

        document |= {
            "nms_px": getattr(extractor, "nms_px", None),
            "threshold": extractor.threshold,
            "provider": settings.learned.provider,
            "onnxruntime": onnxruntime.__version__,
        }
    return line(document)


def features_key(image: U8, how: bytes) -> bytes:
    """The hash, 32 bytes, of the features of an image (H, W) that come of `extraction`."""
    size = b"x".join(str(length).encode() for length in image.shape)
    return hashlib.sha256(_FEATURES + how + size + b"\n" + image.tobytes()).digest()


def comparison(camera: Camera, rules: Mapping[str, float]) -> bytes:
    """What, besides their features, decides a pair's geometry; one line for `pair_key`."""
    lens = {name: value for name, value in camera.as_dict().items() if name != "readout_s"}
    if math.isfinite(camera.lens.reach):  # beyond it key points are left out, which numbers them
        lens["reach"] = camera.lens.reach
    return line({"camera": lens, "rules": dict(rules), "opencv": cv2.__version__})


def pair_key(first: bytes, second: bytes, how: bytes) -> bytes:
    """The hash, 32 bytes, of the geometry of two images, by their features' and `comparison`."""
    return hashlib.sha256(_PAIR + how + first + second).digest()


def line(document: dict[str, Any]) -> bytes:
    """What is hashed of plain values."""
    return json.dumps(document, sort_keys=True, allow_nan=False).encode() + b"\n"
