"""What happens to a flight's frames on their way, and to the map they meet, in a row of a table."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from ground_station.arrays import Bools
from ground_station.experiments import disturbances
from ground_station.experiments.disturbance import Disturbance
from ground_station.experiments.material import Flown
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map
from ground_station.recording.frames import Frame
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError


@functools.cache
def kinds() -> dict[str, type[Disturbance]]:
    """The disturbance that each key of `alter` belongs to."""
    modules = (
        importlib.import_module(f"{disturbances.__name__}.{found.name}")
        for found in pkgutil.iter_modules(disturbances.__path__)
    )
    return {
        key.name: module.DISTURBANCE for module in modules for key in fields(module.DISTURBANCE)
    }


@dataclass(frozen=True)
class Alteration:
    """Some disturbances, pictures in the order of their files' names."""

    parts: tuple[Disturbance, ...] = ()

    @classmethod
    def of(cls, table: Mapping[str, Any], where: str) -> Alteration:
        """From a row's table `alter`; raises `ConfigError`."""
        known = kinds()
        own: dict[type[Disturbance], dict[str, Any]] = {kind: {} for kind in known.values()}
        for name, value in table.items():
            if name not in known:
                there = ", ".join(sorted(known))
                raise ConfigError(f"{where}: unknown key 'alter.{name:.60}' (known here: {there})")
            own[known[name]][name] = value
        where = f"{where}: alter"
        return cls(
            tuple(
                config.from_mapping(keys, kind, where=where) for kind, keys in own.items() if keys
            )
        )

    def keeps(self, index: int) -> bool:
        """Whether the frame of that index in the flight is seen, unless it was lost on its way."""
        return all(part.keeps(index) for part in self.parts)

    def frames(self, frames: Iterable[Frame], arrived: Bools | None = None) -> Iterator[Frame]:
        """The frames that a localizer sees.

        `arrived` (n,) says of each frame of the flight, by its index, whether it could be decoded;
        None: all. Times, and the indices in the flight, stay.
        """
        start_ns: int | None = None
        for frame in frames:
            start_ns = frame.time_ns if start_ns is None else start_ns
            if not self.keeps(frame.index) or (arrived is not None and not arrived[frame.index]):
                continue
            image, time_s = frame.image, (frame.time_ns - start_ns) / 1e9
            for part in self.parts:
                image = part.picture(image, time_s)
            yield replace(frame, image=image)

    def camera(self, camera: Camera) -> Camera:
        """The camera of the frames that are seen."""
        for part in self.parts:
            camera = part.camera(camera)
        return camera

    def told_ns(self, frame: Frame, seed: int) -> int:
        """The time that the localizer is told, in the clock of the frame's own."""
        late_s = sum(part.late_s(frame.index, seed) for part in self.parts)
        return frame.time_ns + round(1e9 * late_s)

    def arrivals(self, flight: Flown, seed: int) -> Bools | None:
        """Which frames of a recorded flight can be decoded (n,); None: all."""
        if flight.recording is None:
            return None
        found = [part.arrivals(flight.units, seed) for part in self.parts]
        lossy = [arrived for arrived in found if arrived is not None]
        return functools.reduce(lambda a, b: a & b, lossy) if lossy else None

    def map(self, map_: Map, seed: int) -> Map:
        """The map that is flown in."""
        for part in self.parts:
            map_ = part.map(map_, seed)
        return map_

    @property
    def blind_until_s(self) -> float | None:
        """When a lens that was covered sees again, after the flight's first frame."""
        ends = [end for part in self.parts if (end := part.blind_until_s) is not None]
        return max(ends, default=None)
