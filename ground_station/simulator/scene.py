"""What a scene is: surfaces, surveyed points, lamps, and its plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_station.arrays import F64
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
class Scene:
    """A building: surfaces, its plan, surveyed points, lamps, and the seed of its textures."""

    name: str
    size_m: tuple[float, float, float]
    surfaces: tuple[Surface, ...]
    footprints: tuple[Footprint, ...]
    known_points: tuple[KnownPoint, ...]
    lamps: tuple[tuple[float, float, float], ...]
    """Where they are, metres; they shine downwards."""
    texture_seed: int
    walks: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Closed ways on foot by their corners (x, y), metres, through the middles of doorways."""
    ring_m: tuple[float, float] | None = None
    """Half axes, along x and y, of an ellipse about the middle that is kept free of things."""

    @property
    def centre_m(self) -> F64:
        """The middle (3,)."""
        return np.asarray(self.size_m) / 2
