"""The hall: 18 x 12 x 5.4 m, its walls of panels that are equal prints, for the plan `stills`.

Three panels of four are the same two plates over and over, and so are the strips between them, the
pilasters, the skirting and the ceiling: a view of one stretch of wall matches every other one.
What tells the stretches apart is what does so in a real hall: doors with their numbers, posters,
furniture, boxes on the wall, and the floor's stains. The floor above has panels, doors and lamps at
the same places, and other posters, furniture and stains; where it is alike its plates are the same,
too. A glazed hall has dark panes for a third of its northern wall, which show the hall as windows
do at night. x runs east along the long walls, z up; the origin is the south-west corner on the
floor. Light falls in through the roof.
"""

from __future__ import annotations

from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.scene import Footprint, Scene

LENGTH_M, WIDTH_M, HEIGHT_M = 18.0, 12.0, 5.4
PANEL_M, ROW_M = 1.5, 1.35
TEXTURE_SEED = 77023

_WHITE, _OCHRE, _DARK = (0.70, 0.69, 0.65), (0.46, 0.33, 0.16), (0.13, 0.13, 0.14)
_GREY, _RED, _BLUE = (0.40, 0.40, 0.41), (0.42, 0.09, 0.07), (0.11, 0.19, 0.36)
_PANEL, _STRIP, _PILASTER, _TILE, _BEAM = (1_000_000 + 100 * k for k in range(5))


class _Wall:
    """A wall: where things on it are, by metres along it, off it and above the floor."""

    def __init__(self, start: tuple[float, float], along: tuple[int, int], length_m: float) -> None:
        self.start, self.along, self.length_m = start, along, length_m
        self.inwards = (-along[1], along[0])  # to the left of `along`

    def at(self, along_m: float, off_m: float, z_m: float) -> list[float]:
        x, y = (
            s + along_m * a + off_m * n
            for s, a, n in zip(self.start, self.along, self.inwards, strict=True)
        )
        return [x, y, z_m]

    def rightwards(self, length_m: float) -> list[float]:
        """A run along the wall from left to right, as one who looks at it sees it."""
        return [-length_m * self.along[0], -length_m * self.along[1], 0.0]

    def solid(self, along_m: tuple[float, float], depth_m: float, z_m: tuple[float, float]
              ) -> tuple[list[float], list[float]]:  # fmt: skip
        """The low and the high corner of a box that stands out from the wall."""
        ends = self.at(along_m[0], 0.0, z_m[0]), self.at(along_m[1], depth_m, z_m[1])
        low, high = ([f(a, b) for a, b in zip(*ends, strict=True)] for f in (min, max))
        return low, high


_SOUTH = _Wall((0.0, 0.0), (1, 0), LENGTH_M)
_EAST = _Wall((LENGTH_M, 0.0), (0, 1), WIDTH_M)
_NORTH = _Wall((LENGTH_M, WIDTH_M), (-1, 0), LENGTH_M)
_WEST = _Wall((0.0, WIDTH_M), (0, -1), WIDTH_M)

_DOORS = ((_SOUTH, 2.3, "H 1"), (_SOUTH, 12.6, "H 2"), (_EAST, 4.1, "EXIT"), (_NORTH, 3.4, "H 4"),
          (_NORTH, 14.1, "H 5"), (_WEST, 7.6, "H 6"))  # fmt: skip
# Wall, metres along it to the right edge as seen, above the floor, width, height, headline.
_POSTERS = (
    (_SOUTH, 6.1, 1.2, 1.1, 1.6, "CONCERT"), (_SOUTH, 9.3, 2.1, 1.5, 1.0, "MAP"),
    (_SOUTH, 15.4, 1.1, 0.9, 1.3, "DANCE"), (_EAST, 1.2, 1.3, 1.2, 1.7, "SCIENCE"),
    (_EAST, 8.7, 1.7, 1.6, 1.1, "WELCOME"), (_NORTH, 0.9, 1.4, 0.9, 1.2, "JOBS"),
    (_NORTH, 7.2, 1.1, 1.3, 1.9, "OPERA"), (_NORTH, 10.6, 2.3, 2.0, 0.9, "LIBRARY"),
    (_WEST, 2.2, 1.2, 1.4, 1.5, "TRAVEL"), (_WEST, 10.4, 1.6, 0.8, 1.1, "RULES"),
)  # fmt: skip
# Low x, low y, length, width, height, material, colour; all below what flies and what is walked.
_FURNITURE = (
    (1.0, 0.5, 0.45, 1.9, 0.48, "wood", None), (5.0, 0.5, 2.2, 0.5, 0.48, "wood", None),
    (10.6, 0.4, 1.4, 0.6, 1.05, "metal", _BLUE), (16.6, 1.0, 0.9, 0.9, 0.74, "wood", None),
    (16.9, 6.4, 0.6, 2.3, 0.48, "fabric", _RED), (12.3, 11.0, 2.4, 0.6, 0.48, "wood", None),
    (8.2, 10.9, 0.8, 0.8, 0.74, "metal", _WHITE), (3.0, 10.7, 1.9, 0.8, 0.95, "wood", _DARK),
    (0.5, 3.6, 0.7, 1.5, 0.45, "fabric", _BLUE), (0.4, 8.9, 1.0, 0.5, 1.15, "metal", _GREY),
    (5.0, 5.2, 0.7, 0.7, 0.45, "fabric", _RED), (12.6, 3.3, 0.6, 1.2, 0.48, "wood", None),
)  # fmt: skip
_PLANTS = ((2.0, 11.2), (17.3, 10.9), (8.7, 0.5), (17.2, 3.6), (0.5, 6.4))


_PANES = range(4, 9), range(3)
"""Panels of the northern wall that are of glass where it is glazed: along it, and from below."""
_REFLECTS = 0.3
"""Of the light, at any angle, as coated glass does; of clear glass it is 8 % head-on (Fresnel)."""


def _panels(b: SceneBuilder, wall: _Wall, glazed: bool) -> None:
    """Chequers of two plates, strips between them, pilasters at every third, the skirting."""
    for j in range(round(wall.length_m / PANEL_M)):
        for k in range(round(HEIGHT_M / ROW_M)):
            if glazed and j in _PANES[0] and k in _PANES[1]:
                continue
            is_dark = (j + k) % 2
            material = "wood" if is_dark else "concrete"
            b.rectangle(
                wall.at((j + 1) * PANEL_M, 0, ROW_M * k), wall.rightwards(PANEL_M), [0, 0, ROW_M],
                material, rgb=_OCHRE if is_dark else _WHITE, tie_m=0.3, plank_m=0.25,
                print=_PANEL + is_dark,
            )  # fmt: skip
        seam = wall.solid((j * PANEL_M - 0.02, j * PANEL_M + 0.02), 0.02, (0.12, HEIGHT_M))
        if j and j % 3:
            b.box(*seam, "metal", rgb=_DARK, print=_STRIP)
        elif j:
            post = wall.solid((j * PANEL_M - 0.14, j * PANEL_M + 0.14), 0.16, (0.0, HEIGHT_M))
            b.box(*post, "concrete", rgb=_GREY, print=_PILASTER)
        foot = wall.solid((j * PANEL_M, (j + 1) * PANEL_M), 0.03, (0.0, 0.12))
        b.box(*foot, "wood", rgb=_DARK, print=_STRIP + 1)


def _roof(b: SceneBuilder) -> list[tuple[float, float, float]]:
    """Equal tiles, rooflights in a grid and the sky in them, beams across."""
    for i in range(9):
        for j in range(6):
            x, y, z = 2.0 * i, 2.0 * j, HEIGHT_M
            if i % 2 and j in (1, 4):
                b.rooflight(x, y, z, 2, 0.4, _WHITE)
            else:
                b.rectangle([x, y + 2, z], [2, 0, 0], [0, -2, 0], "concrete", rgb=_WHITE,
                            tie_m=0.5, detail=0.6, print=_TILE)  # fmt: skip
    for i in range(1, 9):
        b.box([2.0 * i - 0.1, 0, HEIGHT_M - 0.35], [2.0 * i + 0.1, WIDTH_M, HEIGHT_M], "wood",
              faces=("-x", "+x", "-z"), detail=0.6, print=_BEAM)  # fmt: skip
    # Eaves, so that no light falls in where the walls meet the ceiling.
    x1, y1, z = LENGTH_M + 0.3, WIDTH_M + 0.3, HEIGHT_M + 0.2
    for (x, y), length, width in (
        ((-0.3, -0.3), x1 + 0.3, 0.9),
        ((-0.3, y1 - 0.9), x1 + 0.3, 0.9),
        ((-0.3, -0.3), 0.9, y1 + 0.3),
        ((x1 - 0.9, -0.3), 0.9, y1 + 0.3),
    ):
        b.rectangle([x, y, z], [length, 0, 0], [0, width, 0], "metal", detail=0.1)
    for (x, y), side in (((-0.3, -0.3), (x1 + 0.3, 0.0)), ((x1, -0.3), (0.0, y1 + 0.3)),
                      ((x1, y1), (-x1 - 0.3, 0.0)), ((-0.3, y1), (0.0, -y1 - 0.3))):  # fmt: skip
        b.rectangle([x, y, 0], [*side, 0], [0, 0, z], "metal", detail=0.1)
    b.rectangle([0, WIDTH_M, z + 3], [LENGTH_M, 0, 0], [0, -WIDTH_M, 0], "sky", detail=0.2,
                outside=True)  # fmt: skip
    return [(4.5 * i, y, HEIGHT_M - 0.5) for i in (1, 2, 3) for y in (3.0, 9.0)]


def build_hall(
    texels_per_m: float, *, glazed: bool = False, above: bool = False, alike: bool = False
) -> Scene:
    """The scene `hall`, glazed, or the floor above it, in coordinates of its own floor."""
    b = SceneBuilder(texels_per_m, storey=int(above), alike=alike)
    b.outer_walls(LENGTH_M, WIDTH_M)
    for i in range(6):
        for j in range(3):
            b.rectangle([3 * i, 4 * j, 0], [3, 0, 0], [0, 4, 0], "terrazzo", slab_m=0.75,
                        detail=0.8)  # fmt: skip
    for wall in (_SOUTH, _EAST, _NORTH, _WEST):
        _panels(b, wall, glazed and wall is _NORTH)
    b.lamps = _roof(b)
    for wall, at, text in _DOORS:
        text = text.replace("H ", "H 1") if above else text
        b.rectangle(wall.at(at + 1.1, 0.03, 0), wall.rightwards(1.1), [0, 0, 2.15], "door",
                    text=text, detail=1.3)  # fmt: skip
        for post in (at - 0.1, at + 1.1):
            b.box(*wall.solid((post, post + 0.1), 0.07, (0.0, 2.25)), "wood", upright=True)
    for wall, at, z, width, height, text in _POSTERS:
        at, text = (wall.length_m - width - at, text[::-1]) if above else (at, text)
        b.sign(f"sign-{text.lower()}", wall.at(at + width, 0.03, z), wall.rightwards(width),
               [0, 0, height], text)  # fmt: skip
    for wall, at in ((_SOUTH, 4.0), (_EAST, 10.9), (_NORTH, 6.1), (_WEST, 6.6)):  # fuse boxes
        b.box(*wall.solid((at, at + 0.5), 0.14, (1.3, 2.0)), "metal", rgb=_RED)
    for x, y, length, width, height, material, rgb in _FURNITURE:
        y = WIDTH_M - width - y if above else y
        colour = {} if rgb is None else {"rgb": rgb}
        b.stand([x, y, 0], [x + length, y + width, height], material, faces=OPEN, **colour)
    for x, y in _PLANTS:
        y = WIDTH_M - y if above else y
        b.box([x - 0.2, y - 0.2, 0], [x + 0.2, y + 0.2, 0.45], "concrete", rgb=_DARK)
        b.box([x - 0.3, y - 0.3, 0.45], [x + 0.3, y + 0.3, 1.25], "foliage")
        b.footprints.append(Footprint((x - 0.2, y - 0.2, x + 0.2, y + 0.2), "furniture"))
    if glazed:
        along, rows = _PANES
        left = _NORTH.at(PANEL_M * along.start, 0.0, 0.0)
        right = [PANEL_M * len(along) * a for a in _NORTH.along]
        pane = b.rectangle(left, [*right, 0.0], [0, 0, ROW_M * len(rows)], "metal", detail=0.1)
        b.mirrors(pane, _REFLECTS)
    name = "hall" + "-glazed" * glazed + "-above" * above + "-alike" * alike
    return b.scene(name, (LENGTH_M, WIDTH_M, HEIGHT_M), TEXTURE_SEED)
