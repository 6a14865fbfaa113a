"""Features of many images in files, mapped into memory image by image when they are looked at.

Ten thousand images have gigabytes of descriptors. Here they lie on disk, as exact as the extractor
gave them; what stays in memory is where each image's begin. Who compares images on this machine,
in this process or another, gets that and reads them itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, F64
from ground_station.features.extractor import Features

Out = TypeVar("Out")
Side = tuple[F32, F64]
"""What a comparison needs of an image: descriptors (N, D) and undistorted pixels (N, 2)."""

_ALIGNED = 64
"""Bytes; an image's features begin at a multiple of a cache line."""


@dataclass(frozen=True)
class Place:
    """Where an image's N features of D numbers are: `offset` bytes into a file."""

    path: str
    offset: int
    count: int
    dimension: int

    def features(self) -> Features:
        """The features, mapped for as long as somebody holds them; not to be written to."""
        n, d = self.count, self.dimension
        values = _mapped(self.path, self.offset, n * (3 + d), np.dtype("<f4"))
        pixels, scores, descriptors = np.split(values, [2 * n, 3 * n])
        return Features(pixels.reshape(n, 2), scores, descriptors.reshape(n, d))


@dataclass(frozen=True)
class KeptSide:
    """Where an image's `Side` is: its features, and its undistorted pixels in another file."""

    place: Place
    path: str
    offset: int

    def load(self) -> Side:
        """Descriptors and pixels, as `Place.features` gives them."""
        pixels = _mapped(self.path, self.offset, 2 * self.place.count, np.dtype("<f8"))
        return self.place.features().descriptors, pixels.reshape(-1, 2)


class Lazily(Sequence[Out]):
    """`count` values, each got again when it is asked for."""

    def __init__(self, count: int, get: Callable[[int], Out]) -> None:
        self._count, self._get = count, get

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Out: ...

    @overload
    def __getitem__(self, index: slice) -> list[Out]: ...

    def __getitem__(self, index: int | slice) -> Out | list[Out]:
        which = range(self._count)[index]
        return self._get(which) if isinstance(which, int) else [self._get(k) for k in which]


class KeptFeatures(Lazily[Features]):
    """The features of images, each mapped when it is asked for."""

    def __init__(self, places: Sequence[Place]) -> None:
        super().__init__(len(places), lambda k: places[k].features())
        self._places = places

    def sides(self, pixels: Sequence[F64]) -> list[KeptSide]:
        """What a comparison needs, with undistorted pixels (N, 2), which go to a file, too."""
        path = Path(self._places[0].path).with_name("pixels.bin")
        result = []
        with path.open("wb") as file:
            for place, mine in zip(self._places, pixels, strict=True):
                result.append(KeptSide(place, str(path), file.tell()))
                file.write(np.ascontiguousarray(mine, "<f8").tobytes())
        return result


class FeatureFile:
    """Puts features of images, in any order, into a new file of a folder.

    Raises `OSError` where the disk refuses.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = (folder / "features.bin").absolute()
        self._file = self._path.open("wb")
        self._places: dict[int, Place] = {}

    def put(self, index: int, features: Features) -> None:
        """Keeps the features of one image."""
        self._file.write(bytes(-self._file.tell() % _ALIGNED))
        n, d = features.descriptors.shape
        self._places[index] = Place(str(self._path), self._file.tell(), n, d)
        for part in (features.keypoints_px, features.scores, features.descriptors):
            self._file.write(np.ascontiguousarray(part, "<f4").tobytes())

    def close(self) -> KeptFeatures:
        """What was put there, by index."""
        self._file.close()
        return KeptFeatures([self._places[k] for k in range(len(self._places))])


def _mapped(path: str, offset: int, count: int, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    if not count:  # nothing cannot be mapped
        return np.empty(0, kind)
    return np.asarray(np.memmap(path, kind, "r", offset, (count,)))
