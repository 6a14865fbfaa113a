"""A floor plan in ROS map_server's form: a picture, its resolution, and where its corner lies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import yaml

from ground_station.arrays import U8
from ground_station.errors import InputError
from ground_station.recording.folder import read_grey

_MOST_BYTES = 64 << 10


@dataclass(frozen=True)
class FloorPlan:
    """`image` (H, W) uint8, row 0 at the top; its lower left corner lies at `origin` in the world.

    `origin` is x, y (metres) and yaw (rad, counter-clockwise); `resolution_m` is one pixel's side.
    """

    image: U8
    resolution_m: float
    origin: tuple[float, float, float]

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height in metres."""
        height, width = self.image.shape
        return width * self.resolution_m, height * self.resolution_m


def load_floorplan(path: str | Path) -> FloorPlan:
    """Reads `floorplan.yaml` and its picture; raises `InputError` with one line."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES:
            raise InputError(f"{path}: more than {_MOST_BYTES} bytes, which no floor plan's has")
        document = yaml.safe_load(text)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    # Its numbers and dates are converted as it is read, and its nests call themselves.
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError):
        raise InputError(f"{path}: not valid YAML") from None
    try:
        name, resolution_m = document["image"], float(document["resolution"])
        x, y, yaw = (float(value) for value in document["origin"])
        if not isinstance(name, str) or "\0" in name:  # a list of aliases to lists has no end
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: needs image, resolution and origin [x, y, yaw]") from None
    if not all(map(math.isfinite, (resolution_m, x, y, yaw))) or not 1e-4 <= resolution_m <= 10:
        raise InputError(f"{path}: resolution is {resolution_m}; allowed: 0.0001 to 10 m a pixel")
    picture = path.parent / name
    try:
        inside = picture.resolve().is_relative_to(path.parent.resolve())
    except (OSError, RuntimeError, ValueError):  # links in a circle, half characters
        inside = False
    if not inside:
        raise InputError(f"{path}: image is {name[:80]!r}; it must lie beside the file")
    return FloorPlan(read_grey(picture), resolution_m, (x, y, yaw))
