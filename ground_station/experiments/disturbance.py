"""What a disturbance of an experiment may do; each is a file in `disturbances/`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ground_station.arrays import U8, Bools
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map


@dataclass(frozen=True)
class Disturbance:
    """Does nothing. A child's fields are its keys in a row's table `alter`, made by `config.key`.

    Chance follows from the seed of the flight, so that each preset meets the same.
    """

    def keeps(self, index: int) -> bool:
        """Whether the frame of that index in the flight is seen."""
        return True

    def picture(self, image: U8, time_s: float) -> U8:
        """The picture (H, W) that is seen `time_s` after the flight's first."""
        return image

    def camera(self, camera: Camera) -> Camera:
        """The camera of such pictures."""
        return camera

    def late_s(self, index: int, seed: int) -> float:
        """By what the time that the localizer is told of a frame is off."""
        return 0.0

    def arrivals(self, units: Callable[[], Iterable[bytes]], seed: int) -> Bools | None:
        """Which access units of the flight's H.264 can be decoded (n,); None: all."""
        return None

    def map(self, map_: Map, seed: int) -> Map:
        """The map that is flown in."""
        return map_

    @property
    def blind_until_s(self) -> float | None:
        """When a lens that was covered sees again, after the flight's first frame."""
        return None
