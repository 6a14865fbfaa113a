"""Collects a scene: rectangles, the solids made of them, and what the floor plan and lists hold."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.simulator.scene import Footprint, KnownPoint, Scene, Surface

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
OPEN = ("-x", "+x", "-y", "+y", "+z")
"""Of what stands on something."""
REFLECTION = "reflection"
"""Material of what a pane shows: the texture of surface `of`, as seen in a mirror."""
_OF_A_STOREY = 2_000_000
"""First of the numbers by which textures of a storey are drawn; above those of all plates."""


class SceneBuilder:
    """Collects what a scene is of; every solid is made of rectangles.

    Textures are drawn by a surface's number, so scenes of equal rooms have equal ones; those of
    another `storey` are others, but where it is `alike` for prints of a plate.
    """

    def __init__(self, texels_per_m: float, storey: int = 0, *, alike: bool = False) -> None:
        self.texels_per_m, self.storey, self.alike = texels_per_m, storey, alike
        self.surfaces: list[Surface] = []
        self.footprints: list[Footprint] = []
        self.known: list[KnownPoint] = []
        self.lamps: list[tuple[float, float, float]] = []

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
        if self.storey and not (self.alike and "print" in options):
            number = options.get("print", len(self.surfaces))
            options["print"] = self.storey * _OF_A_STOREY + number
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

    def stand(
        self, low_m: Sequence[float], high_m: Sequence[float], material: str, **options: Any
    ) -> None:
        """Adds a box of furniture, which the floor plan shows."""
        self.box(low_m, high_m, material, **options)
        self.footprints.append(Footprint((low_m[0], low_m[1], high_m[0], high_m[1]), "furniture"))

    def rooflight(
        self, x: float, y: float, z: float, side_m: float, curb_m: float, rgb: tuple[float, ...]
    ) -> None:
        """Adds the curbs, seen from below, of a square hole in a ceiling: its low corner."""
        s = side_m
        for origin, u in (
            ([x + s, y, z], [-s, 0, 0]), ([x, y + s, z], [s, 0, 0]),
            ([x, y, z], [0, s, 0]), ([x + s, y + s, z], [0, -s, 0]),
        ):  # fmt: skip
            self.rectangle(origin, u, [0, 0, curb_m], "plaster", rgb=rgb)

    def mirrors(self, pane: Surface, share: float) -> None:
        """Adds what a pane of dark glass shows: a share of the light of all that is there so far.

        Its back, which no camera sees, is to the room; what is beyond it are the room's surfaces
        reflected in its plane. Who walks is not, nor is what other panes show.
        """
        normal = pane.normal
        flip = np.eye(3) - 2 * np.outer(normal, normal)
        for number, s in enumerate(tuple(self.surfaces)):
            behind_m = (pane.origin_m - s.corners()) @ normal
            if s.outside or behind_m.max() < 1e-6:
                continue
            u, v = flip @ s.u_m, flip @ s.v_m
            origin = s.origin_m + 2 * ((pane.origin_m - s.origin_m) @ normal) * normal
            # A reflection turns fronts into backs: from its other end its columns run as u does.
            self.surfaces.append(
                Surface(origin + u, -u, v, REFLECTION, s.texels_per_m,
                        {"of": number, "share": share}, outside=True)
            )  # fmt: skip

    def walls(self, *bounds_m: tuple[float, float, float, float]) -> None:
        """Adds walls to the floor plan: low x, low y, high x, high y of each."""
        self.footprints += [Footprint(bounds, "wall") for bounds in bounds_m]

    def outer_walls(self, length_m: float, width_m: float) -> None:
        """Adds the four walls around a hall to the floor plan, 0.3 m thick."""
        x, y = length_m + 0.3, width_m + 0.3
        self.walls((-0.3, -0.3, x, 0.0), (-0.3, width_m, x, y),
                   (-0.3, 0.0, 0.0, width_m), (length_m, 0.0, x, width_m))  # fmt: skip

    def survey(self, name: str, surface: Surface, corner: int) -> None:
        """Makes a corner of a surface (0: origin, 1: +u, 2: +u+v, 3: +v) a known point."""
        x, y, z = surface.corners()[corner].tolist()
        a, b, c = surface.normal.tolist()
        self.known.append(KnownPoint(name, (x, y, z), (a, b, c)))

    def sign(
        self,
        name: str,
        origin_m: Sequence[float],
        u_m: Sequence[float],
        v_m: Sequence[float],
        text: str,
        **options: Any,
    ) -> None:
        """Adds a poster with two of its corners surveyed, `name`-a and `name`-b."""
        surface = self.rectangle(origin_m, u_m, v_m, "poster", detail=1.6, text=text, **options)
        for corner, end in ((0, "a"), (2, "b")):
            self.survey(f"{name}-{end}", surface, corner)

    def scene(
        self, name: str, size_m: tuple[float, float, float], texture_seed: int, **more: Any
    ) -> Scene:
        """What was collected; its textures are the same for every flight."""
        return Scene(
            name=name,
            size_m=size_m,
            surfaces=tuple(self.surfaces),
            footprints=tuple(self.footprints),
            known_points=tuple(self.known),
            lamps=tuple(self.lamps),
            texture_seed=texture_seed,
            **more,
        )
