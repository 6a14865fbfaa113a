"""What a scene is, and the registry of scenes by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ground_station.errors import GroundStationError
from ground_station.simulator.surfaces import Surface


class SimulatorError(GroundStationError):
    """A simulation that cannot be set up or written."""


@dataclass(frozen=True)
class Footprint:
    """A thing on the floor plan: a rectangle (low x, low y, high x, high y), or a disc in it."""

    bounds_m: tuple[float, float, float, float]
    kind: str  # wall, pillar, furniture, stairs, balcony, glass
    disc: bool = False


@dataclass(frozen=True)
class KnownPoint:
    """A surveyed point: its name and world coordinates, metres, and the surface's normal there."""

    name: str
    position_m: tuple[float, float, float]
    normal: tuple[float, float, float]


@dataclass(frozen=True)
class Lamp:
    """A lamp that shines downwards from a position, metres."""

    position_m: tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """A building: surfaces, its plan, surveyed points, lamps, and the seed of its textures."""

    name: str
    size_m: tuple[float, float, float]
    surfaces: tuple[Surface, ...]
    footprints: tuple[Footprint, ...]
    known_points: tuple[KnownPoint, ...]
    lamps: tuple[Lamp, ...]
    texture_seed: int
    centre_m: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_m", tuple(np.asarray(self.size_m) / 2))


def names() -> tuple[str, ...]:
    """The scenes that can be asked for."""
    return ("atrium",)


def build(name: str, texels_per_m: float) -> Scene:
    """The scene of that name; raises `SimulatorError` naming those there are."""
    from ground_station.simulator.atrium import build_atrium

    registry: dict[str, Callable[[float], Scene]] = {"atrium": build_atrium}
    if name not in registry:
        raise SimulatorError(f"scene '{name}' is unknown; there are: {', '.join(registry)}")
    if not 5 <= texels_per_m <= 400:
        raise SimulatorError(f"{texels_per_m} texels per metre; allowed: 5 to 400")
    return registry[name](texels_per_m)
