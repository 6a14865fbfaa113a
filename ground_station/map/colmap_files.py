"""Reads a COLMAP model's binary files: our own before the library does, others' instead of it.

COLMAP's own reader believes every count and number in a file: it asks for what they claim, goes on
behind the file's end, and ends the process where they contradict each other. The layout is that of
COLMAP's "Output Format", with its rigs and frames.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError

PARAMETERS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}
"""How many numbers a camera has, by its model: those that our lens model can hold."""

_OWN = ("PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE")
"""Those of our own models."""

OTHERS = f"what can be taken over is {', '.join(PARAMETERS)}"
"""What is said of the other models."""

_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE",
    "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
"""COLMAP's camera models, each at its number."""

NO_POINT = 2**64 - 1
"""What a key point sees that sees no point."""

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_RIG, _SENSOR, _FURTHER = struct.Struct("<II"), struct.Struct("<iI"), struct.Struct("<iIB")
_FRAME, _DATA, _POSE = struct.Struct("<II7dI"), struct.Struct("<iIQ"), struct.Struct("<7d")
_IMAGE, _OBSERVATION = struct.Struct("<I7dI"), np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_POINT, _TRACK = struct.Struct("<Q3d3BdQ"), np.dtype([("image", "<u4"), ("observation", "<u4")])
_LONGEST_NAME = 4096
_UNIT = 1e-3
"""How far a rotation's quaternion may be from length 1."""


class Fault(Exception):
    """What is wrong with a file, in words."""


@dataclass(frozen=True)
class CameraEntry:
    """A camera as it stands in a file: the model's name, size in pixels, parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageEntry:
    """An image as it stands in a file.

    `pose` is camera from world, a quaternion w, x, y, z and a translation; `points` (N,) has for
    each key point the number of the point that it sees, or `NO_POINT`.
    """

    name: str
    camera: int
    pose: tuple[float, ...]
    points: npt.NDArray[np.uint64]


class _File:
    """A file's bytes, taken one after the other; none is taken that is not there."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        if len(self._data) - self._at < form.size:
            raise Fault("it is cut")
        values = form.unpack_from(self._data, self._at)
        self._at += form.size
        return values

    def count(self) -> int:
        return int(self.take(_COUNT)[0])

    def table(self, kind: np.dtype[Any], count: int) -> npt.NDArray[Any]:
        if count > (len(self._data) - self._at) // kind.itemsize:
            raise Fault("it is cut, or claims more than it holds")
        rows = np.frombuffer(self._data, kind, count, self._at)
        self._at += rows.nbytes
        return rows

    def name(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise Fault("a name in it has no end")
        try:
            name = self._data[self._at : end].decode()
        except UnicodeDecodeError:
            raise Fault("a name in it is not UTF-8") from None
        self._at = end + 1
        return name

    def end(self) -> None:
        if self._at != len(self._data):
            raise Fault("it holds more than it says")


class Files:
    """A model's files by name; within its block, what is wrong is said of the one read last."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder

    def read(self, name: str) -> bytes:
        """All of a file."""
        self._path = self._folder / name
        return self._path.read_bytes()

    def __enter__(self) -> Files:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: object
    ) -> None:
        if isinstance(error, OSError):
            raise MapError(f"{self._path}: {error.strerror or error}") from None
        if isinstance(error, Fault):
            raise MapError(f"{self._path}: not a COLMAP model: {error}") from None


def check(folder: Path) -> None:
    """Raises `MapError` with one line where a map's model is cut or contradicts itself."""
    with Files(folder) as files:
        cameras = _cameras(_File(files.read("cameras.bin")), _OWN, f"a map's is {', '.join(_OWN)}")
        if 1 not in cameras:
            raise Fault("it has no camera 1")
        rigs = _rigs(_File(files.read("rigs.bin")), cameras)
        images = _images(_File(files.read("images.bin")), cameras)
        _frames(_File(files.read("frames.bin")), rigs, images)
        _points(_File(files.read("points3D.bin")), images)


def read(folder: Path) -> tuple[dict[int, CameraEntry], dict[int, ImageEntry]]:
    """Cameras and images of any model whose lens ours can hold; raises `MapError` as `check` does.

    Rigs and frames, which older models lack, are not looked at: the images have poses of their own.
    """
    with Files(folder) as files:
        cameras = _cameras(_File(files.read("cameras.bin")), tuple(PARAMETERS), OTHERS)
        images = _images(_File(files.read("images.bin")), cameras)
        _points(_File(files.read("points3D.bin")), images)
    return cameras, images


def add(known: Any, number: int, what: str) -> None:
    """Raises `Fault` for a number that is there already."""
    if number in known:
        raise Fault(f"it has the {what} {number} twice")


def check_camera(number: int, camera: CameraEntry) -> None:
    """Raises `Fault` for a size or a parameter that no camera has."""
    sizes = camera.width, camera.height
    if not all(0 < size <= 1 << 20 for size in sizes) or not np.isfinite(camera.params).all():
        raise Fault(f"camera {number} cannot be")


def check_pose(pose: tuple[float, ...]) -> None:
    """A quaternion and a translation."""
    values = np.array(pose)
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all() or abs(length - 1) > _UNIT:
        raise Fault("a pose in it is none")


def _cameras(file: _File, held: Sequence[str], others: str) -> dict[int, CameraEntry]:
    cameras: dict[int, CameraEntry] = {}
    for _ in range(file.count()):
        number, model, width, height = file.take(_CAMERA)
        name = _MODELS[model] if 0 <= model < len(_MODELS) else str(model)
        if name not in held:
            raise Fault(f"camera {number} has the model {name}; {others}")
        params = file.take(struct.Struct(f"<{PARAMETERS[name]}d"))
        camera = CameraEntry(name, width, height, params)
        check_camera(number, camera)
        add(cameras, number, "camera")
        cameras[number] = camera
    file.end()
    return cameras


def _rigs(file: _File, cameras: dict[int, CameraEntry]) -> dict[int, set[int]]:
    """The cameras of each rig."""
    rigs: dict[int, set[int]] = {}
    for _ in range(file.count()):
        number, sensors = file.take(_RIG)
        add(rigs, number, "rig")
        rigs[number] = set()
        for place in range(sensors):
            kind, camera, *posed = file.take(_FURTHER if place else _SENSOR)
            if kind != 0 or camera not in cameras or camera in rigs[number]:
                raise Fault(f"a sensor of rig {number} is no camera of the model")
            rigs[number].add(camera)
            if posed and posed[0]:
                check_pose(file.take(_POSE))
    file.end()
    return rigs


def _images(file: _File, cameras: dict[int, CameraEntry]) -> dict[int, ImageEntry]:
    images: dict[int, ImageEntry] = {}
    for _ in range(file.count()):
        number, *pose, camera = file.take(_IMAGE)
        add(images, number, "image")
        check_pose(tuple(pose))
        if camera not in cameras:
            raise Fault(f"image {number} is of a camera that is not there")
        name = file.name()
        observations = file.table(_OBSERVATION, file.count())
        if not np.isfinite(observations["xy"]).all():
            raise Fault(f"a pixel of image {number} is not finite")
        images[number] = ImageEntry(name, camera, tuple(pose), observations["point"])
    file.end()
    return images


def _frames(
    file: _File,
    rigs: dict[int, set[int]],
    images: dict[int, ImageEntry],
) -> None:
    frames: set[int] = set()
    taken: set[int] = set()
    for _ in range(file.count()):
        number, rig, *pose, count = file.take(_FRAME)
        add(frames, number, "frame")
        frames.add(number)
        check_pose(tuple(pose))
        if rig not in rigs:
            raise Fault(f"frame {number} is of a rig that is not there")
        for _ in range(count):
            kind, camera, image = file.take(_DATA)
            if (
                kind != 0
                or camera not in rigs[rig]
                or image not in images
                or images[image].camera != camera
                or image in taken
            ):
                raise Fault(f"an image of frame {number} does not belong to it")
            taken.add(image)
    file.end()
    if taken != images.keys():
        raise Fault("an image belongs to no frame")


def _points(file: _File, images: dict[int, ImageEntry]) -> None:
    tracks = Tracks(images)
    for _ in range(file.count()):
        number, x, y, z, *_, length = file.take(_POINT)
        table = file.table(_TRACK, length)
        tracks.add(number, (x, y, z), table["image"].tolist(), table["observation"].tolist())
    file.end()
    tracks.end()


class Tracks:
    """Holds the points of a file against its images: each says of the other what that one says."""

    def __init__(self, images: dict[int, ImageEntry]) -> None:
        self._images = images
        self._points: set[int] = set()
        self._observations = 0

    def add(
        self, number: int, position: tuple[float, ...], images: list[int], places: list[int]
    ) -> None:
        """A point and its observations: images' numbers and the places of key points in them."""
        add(self._points, number, "point")
        self._points.add(number)
        if not np.isfinite(position).all():
            raise Fault(f"point {number} is not finite")
        observations = list(zip(images, places, strict=True))
        if len(set(observations)) != len(observations):
            raise Fault(f"point {number} has an observation twice")
        for image, place in observations:
            seen = self._images[image].points if image in self._images else ()
            if not 0 <= place < len(seen) or seen[place] != number:
                raise Fault(f"point {number} and image {image} contradict each other")
        self._observations += len(observations)

    def end(self) -> None:
        """After the last point."""
        by_images = sum(int((image.points != NO_POINT).sum()) for image in self._images.values())
        if self._observations != by_images:
            raise Fault("images see points that do not know of it")
