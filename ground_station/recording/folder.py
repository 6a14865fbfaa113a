"""A folder of images as a source of frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from ground_station.arrays import U8
from ground_station.errors import InputError
from ground_station.files import read_bytes
from ground_station.geometry.camera import Camera
from ground_station.recording.frames import ALL_FRAMES, Frame, FrameRange
from pi_firmware.wire.errors import os_errors_as

_MOST_BYTES = 512 << 20
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


class ImageFolder:
    """The images of a folder, sorted by name; frame k is at k / `rate_hz` s whatever the range."""

    def __init__(
        self, path: Path, rate_hz: float = 30.0, frame_range: FrameRange = ALL_FRAMES
    ) -> None:
        self.camera: Camera | None = None
        self.notes: list[str] = []
        self._rate_hz = rate_hz
        self._range = frame_range
        with os_errors_as(path, InputError):
            names = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
        if not names:
            raise InputError(f"{path}: no images in this folder (jpg, png, bmp, tif, webp, pgm)")
        self._paths = [(k, p) for k, p in enumerate(names) if k in frame_range]
        if not self._paths:
            raise InputError(
                f"{path}: the range {frame_range} holds none of its {len(names)} images"
            )

    @property
    def paths(self) -> list[Path]:
        """The files of the frames in the range."""
        return [path for _, path in self._paths]

    def count(self) -> int | None:
        return len(self._paths)

    def __iter__(self) -> Iterator[Frame]:
        shape: tuple[int, ...] | None = None
        for k, path in self._paths:
            image = read_grey(path)
            if shape is not None and image.shape != shape:
                raise InputError(
                    f"{path}: {image.shape[1]}x{image.shape[0]} px, but the images before it have "
                    f"{shape[1]}x{shape[0]} px: keep those of one size, as the camera wrote them"
                )
            shape = image.shape
            yield Frame(k, path.name, round(k * 1e9 / self._rate_hz), image)


def read_grey(path: Path) -> U8:
    """An image file as (H, W) grey, as stored (no turning by EXIF); raises `InputError`."""
    data = read_bytes(path, _MOST_BYTES)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = None
    if data and not _jpeg_is_cut(data):
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:  # a header that claims an absurd size
            image = None
    if image is None:
        raise InputError(f"{path}: not a whole, readable image")
    return np.asarray(image, dtype=np.uint8)


def _jpeg_is_cut(data: bytes) -> bool:
    """Whether a JPEG lacks its end marker; decoders fill the rest with grey and say nothing."""
    if not data.startswith(b"\xff\xd8"):
        return False
    scan = data.rfind(b"\xff\xda")
    return scan < 0 or data.find(b"\xff\xd9", scan) < 0
