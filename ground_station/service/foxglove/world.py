"""The map for those who look: floor plan and landmarks, read on a thread of its own."""

from __future__ import annotations

import contextlib
import math
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from foxglove.messages import (
    Grid,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Vector2,
)

from ground_station.service.foxglove import conversion
from ground_station.service.foxglove.drawing import placed, stamp
from ground_station.service.settings import MapSettings
from pi_firmware.wire.errors import BlimpError

if TYPE_CHECKING:
    from ground_station.service.web.maps import Maps

_CELLS = 1_000_000
_WAITING = 64


@dataclass(frozen=True)
class World:
    """A map: `plan` is None where it has none, `problem` says what could not be read."""

    plan: Plan | None = None
    landmarks: bytes = b""
    """x, y, z by turns, metres, float32, little-endian."""
    problem: str = ""


@dataclass(frozen=True)
class Plan:
    """A floor plan's grey levels (H, W) uint8, row 0 at the lower edge; metres and radians."""

    grey: np.ndarray
    cell_m: float
    origin: tuple[float, float, float]


def coarse(grey: np.ndarray, resolution_m: float) -> tuple[np.ndarray, float]:
    """A floor plan (H, W) of at most a million cells, and its resolution then."""
    import cv2

    factor = math.ceil(math.sqrt(grey.size / _CELLS))
    if factor < 2:
        return grey, resolution_m
    height, width = (max(1, side // factor) for side in grey.shape)
    # Cut to whole cells at the top and the right: the lower left corner is the origin.
    whole = grey[grey.shape[0] - height * factor :, : width * factor]
    smaller = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return smaller, resolution_m * factor


def grid(plan: Plan, time_ns: int) -> Grid:
    """A floor plan as it is drawn, on the floor (z = 0)."""
    height, width = plan.grey.shape
    cells = np.full((height, width, 4), 255, np.uint8)
    cells[..., :3] = plan.grey[..., None]
    x, y, yaw = plan.origin
    return Grid(
        timestamp=stamp(time_ns),
        frame_id=conversion.MAP,
        pose=placed((x, y, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))),
        column_count=width,
        cell_size=Vector2(x=plan.cell_m, y=plan.cell_m),
        row_stride=4 * width,
        cell_stride=4,
        fields=[
            PackedElementField(name=name, offset=at, type=PackedElementFieldNumericType.Uint8)
            for at, name in enumerate(("red", "green", "blue", "alpha"))
        ],
        data=cells.tobytes(),
    )


def cloud(landmarks: bytes, time_ns: int) -> PointCloud:
    """The landmarks as points."""
    return PointCloud(
        timestamp=stamp(time_ns),
        frame_id=conversion.MAP,
        pose=placed((0.0, 0.0, 0.0)),
        point_stride=12,
        fields=[
            PackedElementField(name=name, offset=at, type=PackedElementFieldNumericType.Float32)
            for name, at in (("x", 0), ("y", 4), ("z", 8))
        ],
        data=landmarks,
    )


class Reader:
    """Reads maps by name, one after the other; `take` gets each on the reader's thread."""

    def __init__(self, settings: MapSettings, take: Callable[[World, object], None]) -> None:
        self._settings, self._take = settings, take
        self._asked: queue.Queue[tuple[str, object]] = queue.Queue(_WAITING)
        threading.Thread(target=self._run, name="map", daemon=True).start()

    def ask(self, name: str, whom: object) -> None:
        """Asks for a map; `whom` comes with the answer. Beyond 64 questions nothing is asked."""
        with contextlib.suppress(queue.Full):
            self._asked.put_nowait((name, whom))

    def _run(self) -> None:
        # The dashboard's: the same names, the same landmarks, read again when a file changed.
        from ground_station.service.web.maps import Maps

        maps = Maps(self._settings)
        while True:
            name, whom = self._asked.get()
            self._take(_read(maps, name), whom)


def _read(maps: Maps, name: str) -> World:
    import cv2

    try:
        landmarks, about = maps.landmarks(name), maps.details(name)["floorplan"]
        if about is None:
            return World(landmarks=landmarks)
        picture = np.frombuffer(maps.floorplan(name), np.uint8)
        image = cv2.imdecode(picture, cv2.IMREAD_GRAYSCALE)
        if image is None:
            return World(landmarks=landmarks)
        grey, cell_m = coarse(np.asarray(image, np.uint8), about["resolution_m"])
        x, y, yaw = about["origin"]
        return World(Plan(np.ascontiguousarray(grey[::-1]), cell_m, (x, y, yaw)), landmarks)
    except BlimpError as error:
        return World(problem=str(error))
    except Exception as error:  # a map that is being replaced, or too little memory
        return World(problem=f"{name}: {type(error).__name__}: {error}")
