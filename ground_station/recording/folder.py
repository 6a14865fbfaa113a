"""A folder of images as a source of frames."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from ground_station.arrays import U8
from ground_station.errors import InputError
from ground_station.files import read_bytes
from ground_station.geometry.camera import Camera
from ground_station.recording.frames import ALL_FRAMES, RATE_HZ, Frame, FrameRange
from pi_firmware.wire.errors import os_errors_as

_MOST_BYTES = 512 << 20
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


_UNIT_NS = {13: 1_000_000, 16: 1_000, 19: 1}
"""Of a whole number of so many digits that is a time since 1970: milli-, micro-, nanoseconds."""


class ImageFolder:
    """The images of a folder, sorted by name as a person counts: 2 comes before 10.

    Frame k is at k / `rate_hz` s whatever the range. Without a rate, images that are all named by
    their times, as many data sets name them, have those: seconds with three decimals or more, or
    whole milli-, micro- or nanoseconds since 1970. A note says so. Others are at 30 Hz.
    """

    def __init__(
        self, path: Path, rate_hz: float | None = None, frame_range: FrameRange = ALL_FRAMES
    ) -> None:
        self.camera: Camera | None = None
        self.notes: list[str] = []
        self._range = frame_range
        with os_errors_as(path, InputError):
            found = [p for p in path.iterdir() if p.suffix.lower() in SUFFIXES]
        if not found:
            raise InputError(f"{path}: no images in this folder (jpg, png, bmp, tif, webp, pgm)")
        _check_one_camera(path, found)
        named_ns = _times_ns(found)
        self.timed = bool(named_ns) and rate_hz is None
        if self.timed:
            self.notes.append(f"{path}: its images are named by their times, and have those")
        self._paths = [
            (k, p, named_ns[p] if self.timed else round(k * 1e9 / (rate_hz or RATE_HZ)))
            for k, p in enumerate(sorted(found, key=named_ns.__getitem__ if named_ns else _counted))
            if k in frame_range
        ]
        if not self._paths:
            raise InputError(
                f"{path}: the range {frame_range} holds none of its {len(found)} images"
            )

    @property
    def paths(self) -> list[Path]:
        """The files of the frames in the range."""
        return [path for _, path, _ in self._paths]

    def count(self) -> int | None:
        return len(self._paths)

    def __iter__(self) -> Iterator[Frame]:
        shape: tuple[int, ...] | None = None
        for k, path, time_ns in self._paths:
            image = read_grey(path)
            if shape is not None and image.shape != shape:
                raise InputError(
                    f"{path}: {image.shape[1]}x{image.shape[0]} px, but the images before it have "
                    f"{shape[1]}x{shape[0]} px: keep those of one size, as the camera wrote them"
                )
            shape = image.shape
            yield Frame(k, path.name, time_ns, image)


def _check_one_camera(folder: Path, paths: Sequence[Path]) -> None:
    """Refuses pairs of images that differ in a word only, as colour and depth or left and right."""
    kinds: dict[str, set[tuple[str, ...]]] = {}
    for path in paths:
        kind = re.sub("[0-9]+", "#", path.name)
        kinds.setdefault(kind, set()).add(tuple(re.findall("[0-9]+", path.name)))
    first: dict[frozenset[tuple[str, ...]], str] = {}
    for kind, numbers in kinds.items():
        other = first.setdefault(frozenset(numbers), kind)
        if other != kind and len(numbers) > 1:
            raise InputError(
                f"{folder}: it holds both {min(kind, other)} and {max(kind, other)} of each "
                "number, as of depth or of a second camera: put those of one camera into a folder "
                "of their own"
            )


def _counted(path: Path) -> tuple[list[int | str], str]:
    """Sorts by the numbers in a name; equal ones, as 1 and 01, by the name."""
    parts = re.split("([0-9]+)", path.name)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], path.name


def _times_ns(paths: Sequence[Path]) -> dict[Path, int]:
    """The times that images are named by; of none, where one is not or two have the same."""
    times = {path: time_ns for path in paths if (time_ns := _time_ns(path.stem)) is not None}
    return times if len(set(times.values())) == len(paths) else {}


def _time_ns(stem: str) -> int | None:
    if seconds := re.fullmatch(r"(\d{1,9}|[1-8]\d{9})\.(\d{3,9})", stem, re.ASCII):
        return int(seconds[1]) * 10**9 + int(seconds[2].ljust(9, "0"))
    # Of a counter that is padded with zeros the first digit is no 1 to 8.
    whole = re.fullmatch(r"[1-8]\d+", stem, re.ASCII) and _UNIT_NS.get(len(stem))
    return int(stem) * whole if whole else None


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
