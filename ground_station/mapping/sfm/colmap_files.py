"""Looks through a COLMAP model's binary files before the library reads them.

COLMAP's own reader believes every count and number in a file: it asks for what they claim, goes on
behind the file's end, and ends the process where they contradict each other. The layout is that of
COLMAP's "Output Format", with its rigs and frames.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError

_PINHOLE = 1
_NO_POINT = np.uint64(2**64 - 1)
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ4d")
_RIG, _SENSOR, _FURTHER = struct.Struct("<II"), struct.Struct("<iI"), struct.Struct("<iIB")
_FRAME, _DATA, _POSE = struct.Struct("<II7dI"), struct.Struct("<iIQ"), struct.Struct("<7d")
_IMAGE, _SIGHT = struct.Struct("<I7dI"), np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_POINT, _TRACK = struct.Struct("<Q3d3BdQ"), np.dtype([("image", "<u4"), ("sight", "<u4")])
_LONGEST_NAME = 4096
_UNIT = 1e-3
"""How far a rotation's quaternion may be from length 1."""


class _Fault(Exception):
    """What is wrong, in words."""


class _File:
    """A file's bytes, taken one after the other; none is taken that is not there."""

    def __init__(self, path: Path) -> None:
        self._data, self._at = path.read_bytes(), 0

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        if len(self._data) - self._at < form.size:
            raise _Fault("it is cut")
        values = form.unpack_from(self._data, self._at)
        self._at += form.size
        return values

    def count(self) -> int:
        return int(self.take(_COUNT)[0])

    def table(self, kind: np.dtype[Any], count: int) -> npt.NDArray[Any]:
        if count > (len(self._data) - self._at) // kind.itemsize:
            raise _Fault("it is cut, or claims more than it holds")
        rows = np.frombuffer(self._data, kind, count, self._at)
        self._at += rows.nbytes
        return rows

    def name(self) -> None:
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise _Fault("a name in it has no end")
        try:
            self._data[self._at : end].decode()
        except UnicodeDecodeError:
            raise _Fault("a name in it is not UTF-8") from None
        self._at = end + 1

    def end(self) -> None:
        if self._at != len(self._data):
            raise _Fault("it holds more than it says")


def check(folder: Path) -> None:
    """Raises `MapError` with one line where a model's files are cut or contradict each other."""
    name = ""
    try:
        name = "cameras.bin"
        cameras = _cameras(_File(folder / name))
        name = "rigs.bin"
        rigs = _rigs(_File(folder / name), cameras)
        name = "images.bin"
        images = _images(_File(folder / name), cameras)
        name = "frames.bin"
        _frames(_File(folder / name), rigs, images)
        name = "points3D.bin"
        _points(_File(folder / name), images)
    except OSError as error:
        raise MapError(f"{folder / name}: {error.strerror or error}") from None
    except _Fault as fault:
        raise MapError(f"{folder / name}: not a COLMAP model: {fault}") from None


def _add(known: Any, number: int, what: str) -> None:
    if number in known:
        raise _Fault(f"it has the {what} {number} twice")


def _check_pose(pose: tuple[float, ...]) -> None:
    """A quaternion and a translation."""
    values = np.array(pose)
    if not np.isfinite(values).all() or abs(float(np.linalg.norm(values[:4])) - 1) > _UNIT:
        raise _Fault("a pose in it is none")


def _cameras(file: _File) -> set[int]:
    cameras: set[int] = set()
    for _ in range(file.count()):
        number, model, width, height, *pinhole = file.take(_CAMERA)
        if model != _PINHOLE:
            raise _Fault(f"camera {number} has the model {model}; a map's is PINHOLE ({_PINHOLE})")
        if not (0 < width <= 1 << 20 and 0 < height <= 1 << 20 and np.isfinite(pinhole).all()):
            raise _Fault(f"camera {number} cannot be")
        _add(cameras, number, "camera")
        cameras.add(number)
    file.end()
    if 1 not in cameras:
        raise _Fault("it has no camera 1")
    return cameras


def _rigs(file: _File, cameras: set[int]) -> dict[int, set[int]]:
    """The cameras of each rig."""
    rigs: dict[int, set[int]] = {}
    for _ in range(file.count()):
        number, sensors = file.take(_RIG)
        _add(rigs, number, "rig")
        rigs[number] = set()
        for place in range(sensors):
            kind, camera, *posed = file.take(_FURTHER if place else _SENSOR)
            if kind != 0 or camera not in cameras or camera in rigs[number]:
                raise _Fault(f"a sensor of rig {number} is no camera of the model")
            rigs[number].add(camera)
            if posed and posed[0]:
                _check_pose(file.take(_POSE))
    file.end()
    return rigs


def _images(file: _File, cameras: set[int]) -> dict[int, tuple[int, npt.NDArray[np.uint64]]]:
    """The camera of each image, and of each of its key points the point that it sees."""
    images: dict[int, tuple[int, npt.NDArray[np.uint64]]] = {}
    for _ in range(file.count()):
        number, *pose, camera = file.take(_IMAGE)
        _add(images, number, "image")
        _check_pose(tuple(pose))
        if camera not in cameras:
            raise _Fault(f"image {number} is of a camera that is not there")
        file.name()
        sights = file.table(_SIGHT, file.count())
        if not np.isfinite(sights["xy"]).all():
            raise _Fault(f"a pixel of image {number} is not finite")
        images[number] = camera, sights["point"]
    file.end()
    return images


def _frames(
    file: _File,
    rigs: dict[int, set[int]],
    images: dict[int, tuple[int, npt.NDArray[np.uint64]]],
) -> None:
    frames: set[int] = set()
    taken: set[int] = set()
    for _ in range(file.count()):
        number, rig, *pose, count = file.take(_FRAME)
        _add(frames, number, "frame")
        frames.add(number)
        _check_pose(tuple(pose))
        if rig not in rigs:
            raise _Fault(f"frame {number} is of a rig that is not there")
        for _ in range(count):
            kind, camera, image = file.take(_DATA)
            if (
                kind != 0
                or camera not in rigs[rig]
                or image not in images
                or images[image][0] != camera
                or image in taken
            ):
                raise _Fault(f"an image of frame {number} does not belong to it")
            taken.add(image)
    file.end()
    if taken != images.keys():
        raise _Fault("an image belongs to no frame")


def _points(file: _File, images: dict[int, tuple[int, npt.NDArray[np.uint64]]]) -> None:
    points: set[int] = set()
    sights = 0
    for _ in range(file.count()):
        number, x, y, z, *_, length = file.take(_POINT)
        _add(points, number, "point")
        points.add(number)
        if not np.isfinite((x, y, z)).all():
            raise _Fault(f"point {number} is not finite")
        track = file.table(_TRACK, length)
        if len(np.unique(track)) != len(track):
            raise _Fault(f"point {number} has a sight twice")
        for image, place in track.tolist():
            seen = images[image][1] if image in images else ()
            if place >= len(seen) or seen[place] != number:
                raise _Fault(f"point {number} and image {image} contradict each other")
        sights += len(track)
    file.end()
    seen_by_images = sum(int((seen != _NO_POINT).sum()) for _, seen in images.values())
    if sights != seen_by_images:
        raise _Fault("images see points that do not know of it")
