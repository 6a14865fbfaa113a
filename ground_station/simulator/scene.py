"""What a scene is: flat surfaces, surveyed points, lamps, and its plan.

A surface shows its front where u × v points; its texture's columns run along u, its rows down
from the end of v, so that text reads upright.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import GroundStationError


class SimulatorError(GroundStationError):
    """A simulation that cannot be set up or written."""


@dataclass(frozen=True)
class Surface:
    """A rectangle in world coordinates, metres.

    `texels_per_m` is the resolution of its texture; `outside` marks what lies beyond the building
    (lit by the open sky, casting no shadow into it).
    """

    origin_m: F64
    u_m: F64
    v_m: F64
    material: str
    texels_per_m: float
    options: dict[str, Any] = field(default_factory=dict)
    outside: bool = False

    @property
    def size_m(self) -> tuple[float, float]:
        """Lengths along u and v."""
        return float(np.linalg.norm(self.u_m)), float(np.linalg.norm(self.v_m))

    @property
    def normal(self) -> F64:
        """The unit vector out of the front."""
        n = np.cross(self.u_m, self.v_m)
        return n / np.linalg.norm(n)

    @property
    def size_texels(self) -> tuple[int, int]:
        """Columns and rows of the texture."""
        width, height = (max(4, round(s * self.texels_per_m)) for s in self.size_m)
        return width, height

    def corners(self) -> F64:
        """(4, 3): origin, +u, +u+v, +v."""
        o, u, v = self.origin_m, self.u_m, self.v_m
        return np.stack([o, o + u, o + u + v, o + v])

    def points(self, columns: int, rows: int) -> F64:
        """Centres of a grid over the surface (rows, columns, 3), first row at the end of v."""
        s = (np.arange(columns) + 0.5) / columns
        t = 1 - (np.arange(rows) + 0.5) / rows
        return self.origin_m + s[None, :, None] * self.u_m + t[:, None, None] * self.v_m


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
