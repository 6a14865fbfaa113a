"""Flat surfaces of a scene: rectangles with a material, and the solids made of them.

A rectangle shows its front where u × v points; its texture's columns run along u, its rows down
from the end of v, so that text reads upright.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")


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


class SceneBuilder:
    """Collects surfaces; every solid is made of rectangles."""

    def __init__(self, texels_per_m: float) -> None:
        self.texels_per_m = texels_per_m
        self.surfaces: list[Surface] = []

    def rectangle(
        self,
        origin_m: npt.ArrayLike,
        u_m: npt.ArrayLike,
        v_m: npt.ArrayLike,
        material: str,
        *,
        detail: float = 1.0,
        outside: bool = False,
        **options: Any,
    ) -> Surface:
        """Adds one rectangle; `detail` scales the scene's texture resolution."""
        surface = Surface(
            np.asarray(origin_m, dtype=np.float64),
            np.asarray(u_m, dtype=np.float64),
            np.asarray(v_m, dtype=np.float64),
            material,
            self.texels_per_m * detail,
            options,
            outside,
        )
        self.surfaces.append(surface)
        return surface

    def box(
        self,
        low_m: npt.ArrayLike,
        high_m: npt.ArrayLike,
        material: str,
        *,
        faces: tuple[str, ...] = FACES,
        detail: float = 1.0,
        **options: Any,
    ) -> None:
        """Adds the named faces of an axis-aligned box, each with a texture of its own."""
        lo, hi = np.asarray(low_m, dtype=np.float64), np.asarray(high_m, dtype=np.float64)
        dx, dy, dz = np.diag(hi - lo)
        table: dict[str, tuple[npt.ArrayLike, F64, F64]] = {
            "-y": (lo, dx, dz),
            "+y": ([hi[0], hi[1], lo[2]], -dx, dz),
            "-x": ([lo[0], hi[1], lo[2]], -dy, dz),
            "+x": ([hi[0], lo[1], lo[2]], dy, dz),
            "+z": ([lo[0], lo[1], hi[2]], dx, dy),
            "-z": ([lo[0], hi[1], lo[2]], dx, -dy),
        }
        for face in faces:
            origin, u, v = table[face]
            self.rectangle(origin, u, v, material, detail=detail, **options)

    def prism(
        self,
        centre_m: tuple[float, float],
        radius_m: float,
        z_m: tuple[float, float],
        sides: int,
        material: str,
        **options: Any,
    ) -> None:
        """Adds the mantle of an upright regular prism: a round pillar in `sides` facets."""
        angle = 2 * np.pi * (np.arange(sides + 1) + 0.5) / sides
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius_m + centre_m
        for a, b in itertools.pairwise(ring):
            self.rectangle(
                [a[0], a[1], z_m[0]], [*(b - a), 0], [0, 0, z_m[1] - z_m[0]], material, **options
            )
