"""The rooms: a flat of 12.6 x 9.6 x 2.7 m, five rooms along a passage, for the plan `headset`.

Walls are plain and white; what there is to see are windows, doorways, skirting, pictures and
furniture, other ones in each room. x runs east along the passage, y north, z up; the origin is the
south-west corner on the floor. `Scene.walks` are the closed ways through its doorways.
"""

from __future__ import annotations

from typing import Any

from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.scene import Scene

LENGTH_M, WIDTH_M, HEIGHT_M = 12.6, 9.6, 2.7
PASSAGE_Y_M = (4.0, 5.4)
DOOR_M = 1.0
TEXTURE_SEED = 77029

_WHITE, _DARK, _GREY = (0.72, 0.72, 0.70), (0.13, 0.13, 0.14), (0.40, 0.40, 0.41)
_RED, _BLUE, _GREEN, _SAND = (
    (0.42, 0.09, 0.07), (0.11, 0.19, 0.36), (0.16, 0.27, 0.15), (0.55, 0.46, 0.32),
)  # fmt: skip
_HALF_WALL_M, _DOOR_HEIGHT_M = 0.06, 2.1
_ROOF_M = HEIGHT_M + 0.3  # above the ceiling, so that no light falls in along its edge
_DIRT = 0.05  # of painted plaster; a hall's walls have 0.16

# Walls between rooms: along which axis, where across it, from, to, and the middles of doorways.
_INNER = (
    ("x", PASSAGE_Y_M[1], 0.0, LENGTH_M, (1.6, 6.0, 11.2)),
    ("x", PASSAGE_Y_M[0], 0.0, LENGTH_M, (3.0, 8.0)),
    ("y", 4.6, PASSAGE_Y_M[1], WIDTH_M, (8.2,)),
    ("y", 8.6, PASSAGE_Y_M[1], WIDTH_M, (6.6,)),
    ("y", 6.4, 0.0, PASSAGE_Y_M[0], (1.4,)),
)
# Outer walls: which one, from, to along it, sill and lintel of its window.
_WINDOWS = (
    ("north", 1.0, 3.6), ("north", 5.6, 7.4), ("north", 9.4, 12.0), ("south", 1.4, 4.8),
    ("south", 7.6, 9.4), ("south", 10.2, 12.0), ("west", 4.3, 5.1), ("east", 4.3, 5.1),
)  # fmt: skip
_SILL_M, _LINTEL_M = 0.8, 2.3
# Low x, low y, high x, high y, height, material, colour.
_FURNITURE = (
    (0.15, 5.6, 0.6, 7.4, 1.9, "wood", None), (0.3, 8.5, 1.2, 9.4, 0.74, "wood", _SAND),
    (3.5, 5.7, 4.4, 6.9, 0.55, "fabric", _BLUE), (2.0, 6.2, 2.7, 6.9, 0.5, "fabric", _RED),
    (7.7, 7.6, 8.4, 9.3, 0.9, "metal", _WHITE), (4.8, 5.6, 5.2, 7.2, 1.7, "wood", _DARK),
    (7.2, 5.5, 8.2, 5.9, 2.0, "wood", _SAND), (11.7, 6.2, 12.5, 8.9, 0.5, "fabric", _GREEN),
    (9.0, 9.0, 9.9, 9.5, 1.2, "wood", None), (10.3, 7.3, 10.9, 7.8, 0.42, "wood", _DARK),
    (0.1, 0.3, 0.6, 2.6, 2.0, "wood", _SAND), (1.3, 0.9, 2.3, 2.9, 0.74, "wood", None),
    (4.6, 2.6, 6.2, 3.4, 0.5, "fabric", _RED), (4.4, 0.1, 6.2, 0.5, 0.9, "metal", _GREY),
    (11.9, 0.5, 12.5, 3.4, 1.9, "wood", None), (8.9, 2.3, 9.9, 3.0, 0.74, "metal", _WHITE),
    (6.6, 2.6, 7.1, 3.8, 1.1, "wood", _DARK), (8.6, 0.1, 10.6, 0.55, 0.5, "fabric", _BLUE),
    (12.1, 4.1, 12.5, 4.9, 0.9, "wood", None), (0.1, 4.1, 0.4, 4.6, 1.3, "metal", _RED),
)  # fmt: skip
# Where a picture's lower left corner is as seen, which way it faces, width, height, headline.
_PICTURES = (
    ((4.53, 7.2), "-x", 0.9, 1.1, "SEA"), ((0.01, 7.9), "+x", 0.7, 0.9, "HARBOUR"),
    ((3.0, 5.47), "+y", 0.8, 0.6, "TIDES"), ((4.67, 8.95), "+x", 0.5, 0.7, "SPRING"),
    ((8.53, 8.6), "-x", 0.6, 0.8, "RECIPES"), ((8.67, 7.6), "+x", 1.1, 0.8, "JAZZ"),
    ((10.4, 5.47), "+y", 0.7, 0.9, "FORUM"), ((12.59, 9.2), "-x", 0.6, 0.6, "CHESS"),
    ((0.6, 3.93), "-y", 0.8, 1.0, "ATLAS"), ((4.2, 3.93), "-y", 1.2, 0.7, "RIVERS"),
    ((6.33, 3.0), "-x", 0.6, 0.8, "ANATOMY"), ((6.47, 2.6), "+x", 0.5, 0.7, "STAMPS"),
    ((10.6, 3.93), "-y", 1.0, 0.9, "BRIDGES"), ((12.59, 3.9), "-x", 0.4, 0.6, "NOTES"),
    ((3.6, 5.33), "-y", 0.9, 0.7, "PLAN"), ((9.4, 5.33), "-y", 0.6, 0.9, "COAST"),
    ((5.4, 4.07), "+y", 0.7, 1.0, "FACES"), ((11.2, 4.07), "+y", 1.1, 0.7, "TRAINS"),
)  # fmt: skip
_UPRIGHT = {"-x": (0, -1), "+x": (0, 1), "-y": (1, 0), "+y": (-1, 0)}  # a print's way to the right

# Two closed ways by their corners (x, y): one of some 29 m, one of some 40.
_SHORT = (
    (1.6, 4.7), (1.6, 7.4), (2.8, 8.2), (5.6, 8.2), (6.0, 7.6), (6.0, 4.7), (3.0, 4.7), (3.0, 2.4),
    (4.0, 1.4), (7.4, 1.4), (8.0, 2.2), (8.0, 4.7),
)  # fmt: skip
_LONG = (
    (1.6, 4.7), (3.0, 4.7), (3.0, 2.4), (4.0, 1.4), (10.9, 1.4), (10.9, 3.4), (8.0, 3.4),
    (8.0, 4.7), (11.2, 4.7), (11.2, 8.5), (9.6, 8.3), (9.6, 6.6), (6.1, 6.6), (6.1, 8.2),
    (2.8, 8.2), (1.6, 7.4),
)  # fmt: skip


def _inner_walls(b: SceneBuilder) -> None:
    """Plain walls with doorways, their frames, and the skirting."""

    def block(
        axis: str, at: float, a: float, c: float, z: tuple[float, float], half_m: float,
        material: str = "plaster", **options: Any,
    ) -> None:  # fmt: skip
        lo, hi = [a, at - half_m, z[0]], [c, at + half_m, z[1]]
        if axis == "y":
            lo, hi = [lo[1], lo[0], lo[2]], [hi[1], hi[0], hi[2]]
        b.box(lo, hi, material, **options)
        if z[0] == 0.0 and material == "plaster":
            b.walls((lo[0], lo[1], hi[0], hi[1]))

    for axis, at, start, end, doors in _INNER:
        a = start
        for middle in (*doors, None):
            c = end if middle is None else middle - DOOR_M / 2
            block(axis, at, a, c, (0.0, HEIGHT_M), _HALF_WALL_M, rgb=_WHITE, dirt=_DIRT)
            block(axis, at, a, c, (0.0, 0.08), _HALF_WALL_M + 0.015, "wood", rgb=_SAND)
            if middle is None:
                break
            a = middle + DOOR_M / 2
            block(axis, at, c, a, (_DOOR_HEIGHT_M, HEIGHT_M), _HALF_WALL_M, rgb=_WHITE, dirt=_DIRT)
            for x in (c - 0.05, a - 0.02):
                block(axis, at, x, x + 0.07, (0.0, _DOOR_HEIGHT_M), 0.08, "wood", upright=True)
            block(axis, at, c - 0.05, a + 0.05, (_DOOR_HEIGHT_M - 0.02, 2.16), 0.08, "wood")


def _outer_walls(b: SceneBuilder) -> None:
    """Four walls with windows, their bars and sills, radiators beneath."""
    for side, across, reach in (("north", WIDTH_M, LENGTH_M), ("south", 0.0, LENGTH_M),
                                ("west", 0.0, WIDTH_M), ("east", LENGTH_M, WIDTH_M)):  # fmt: skip
        out = 0.25 if side in ("north", "east") else -0.25

        def block(
            a: float, c: float, z: tuple[float, float], material: str, *,
            off_m: tuple[float, float] = (0.0, out), side: str = side, across: float = across,
            **options: Any,
        ) -> tuple[float, float, float, float]:  # fmt: skip
            p, q = sorted((across + off_m[0], across + off_m[1]))
            lo, hi = ([a, p], [c, q]) if side in ("north", "south") else ([p, a], [q, c])
            b.box([*lo, z[0]], [*hi, z[1]], material, **options)
            return (lo[0], lo[1], hi[0], hi[1])

        paint: dict[str, Any] = {"rgb": _WHITE, "dirt": _DIRT}
        inwards = -1 if out > 0 else 1
        a = 0.0
        for left, right in [(w[1], w[2]) for w in _WINDOWS if w[0] == side]:
            b.walls(block(a, left, (0.0, _ROOF_M), "plaster", **paint))
            b.walls(block(left, right, (0.0, _SILL_M), "plaster", **paint))
            block(left, right, (_LINTEL_M, _ROOF_M), "plaster", **paint)
            bars = (0.4 * out, 0.6 * out)
            for x in (left, (left + right) / 2 - 0.03, right - 0.06):
                block(x, x + 0.06, (_SILL_M, _LINTEL_M), "wood", off_m=bars, rgb=_WHITE)
            for z in (_SILL_M, 1.8, _LINTEL_M - 0.06):
                block(left, right, (z, z + 0.06), "wood", off_m=bars, rgb=_WHITE)
            block(left - 0.05, right + 0.05, (_SILL_M - 0.04, _SILL_M), "wood",
                  off_m=(0.0, 0.08 * inwards), rgb=_SAND)  # fmt: skip
            if right - left > 1:
                block(left + 0.2, right - 0.2, (0.12, 0.62), "metal",
                      off_m=(0.03 * inwards, 0.1 * inwards), rgb=_WHITE)  # fmt: skip
            a = right
        b.walls(block(a, reach, (0.0, _ROOF_M), "plaster", **paint))


def _outside(b: SceneBuilder) -> None:
    """What the windows show: a lawn, hedges, the sky."""
    far = 12.0
    x0, y0, x1, y1 = -far, -far, LENGTH_M + far, WIDTH_M + far
    for low, size in (((x0, y0), (x1 - x0, far - 0.3)), ((x0, WIDTH_M + 0.3), (x1 - x0, far - 0.3)),
                      ((x0, -0.3), (far - 0.3, WIDTH_M + 0.6)),
                      ((LENGTH_M + 0.3, -0.3), (far - 0.3, WIDTH_M + 0.6))):  # fmt: skip
        b.rectangle([*low, -0.1], [size[0], 0, 0], [0, size[1], 0], "foliage", detail=0.15,
                    outside=True)  # fmt: skip
    for corner, u in (((x1, y0), (x0 - x1, 0)), ((x0, y1), (x1 - x0, 0)),
                      ((x0, y0), (0, y1 - y0)), ((x1, y1), (0, y0 - y1))):  # fmt: skip
        for height, material, detail in ((10.0, "sky", 0.25), (2.4, "foliage", 0.3)):
            step = 0.0 if material == "sky" else 0.1  # the hedge stands before the sky
            x, y = (c - step if c > 0 else c + step for c in corner)
            b.rectangle([x, y, -0.2], [*u, 0], [0, 0, height], material, detail=detail,
                        outside=True)  # fmt: skip


def build_rooms(texels_per_m: float) -> Scene:
    """The scene `rooms`."""
    b = SceneBuilder(texels_per_m)
    low, high = PASSAGE_Y_M
    floors = (
        (0.0, 0.0, 6.4, low), (6.4, 0.0, LENGTH_M, low), (0.0, low, LENGTH_M, high),
        (0.0, high, 4.6, WIDTH_M), (4.6, high, 8.6, WIDTH_M), (8.6, high, LENGTH_M, WIDTH_M),
    )  # fmt: skip
    for k, (xa, ya, xb, yb) in enumerate(floors):
        size = [xb - xa, 0, 0], [0, yb - ya, 0]
        tiled = k in (2, 4)
        b.rectangle([xa, ya, 0], *size, "terrazzo" if tiled else "wood", slab_m=0.4, plank_m=0.16)
        b.rectangle([xa, yb, HEIGHT_M], size[0], [0, ya - yb, 0], "plaster", rgb=_WHITE,
                    dirt=_DIRT, detail=0.6)  # fmt: skip
    _inner_walls(b)
    _outer_walls(b)
    _outside(b)
    b.rectangle([-0.5, -0.5, _ROOF_M], [LENGTH_M + 1, 0, 0], [0, WIDTH_M + 1, 0], "concrete",
                detail=0.1)  # fmt: skip
    for xa, ya, xb, yb, height, material, rgb in _FURNITURE:
        colour = {} if rgb is None else {"rgb": rgb}
        b.stand([xa, ya, 0], [xb, yb, height], material, faces=OPEN, **colour)
    for (x, y), facing, width, height, text in _PICTURES:
        along = _UPRIGHT[facing]
        right = [width * along[0], width * along[1], 0]
        b.sign(f"picture-{text.lower()}", [x, y, 1.25], right, [0, 0, height], text)
    b.lamps = [((xa + xb) / 2, (ya + yb) / 2, HEIGHT_M - 0.2) for xa, ya, xb, yb in floors]
    return b.scene("rooms", (LENGTH_M, WIDTH_M, HEIGHT_M), TEXTURE_SEED, walks=(_SHORT, _LONG))
