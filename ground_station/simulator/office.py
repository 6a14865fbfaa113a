"""The office: a floor of 22 x 14 x 4.6 m, open plan, with a corridor and a glazed room at each end.

Another building than the atrium, to tell whether a localizer refuses what its map does not hold:
the same materials and lights, other textures. x runs east, y north, z up; the origin is the
south-west corner on the floor. South: windows. North: the corridor with its equal doors and
notices. The plans' paths keep clear of everything above 1.5 m, as in the atrium.
"""

from __future__ import annotations

from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.scene import Scene

LENGTH_M, WIDTH_M, HEIGHT_M = 22.0, 14.0, 4.6
BAY_M = 2.75
CORRIDOR_Y_M = 12.2
ROOMS_X_M = (1.8, 20.2)
TEXTURE_SEED = 77003

_WHITE, _SAND, _SLATE = (0.72, 0.72, 0.70), (0.58, 0.52, 0.42), (0.24, 0.27, 0.31)
_BLUE, _GREEN, _DARK = (0.11, 0.19, 0.36), (0.20, 0.33, 0.18), (0.12, 0.12, 0.13)


class _Office(SceneBuilder):
    def floor_and_ceiling(self) -> None:
        for k in range(8):
            x = BAY_M * k
            for y, depth in ((0.0, 4.0), (4.0, 4.0), (8.0, 4.2)):
                rgb = _SLATE if (k + int(y)) % 3 else _BLUE
                self.rectangle([x, y, 0], [BAY_M, 0, 0], [0, depth, 0], "terrazzo", slab_m=0.5,
                               rgb=rgb, detail=0.9)  # fmt: skip
            self.rectangle([x, CORRIDOR_Y_M, 0], [BAY_M, 0, 0], [0, 1.8, 0], "wood", plank_m=0.18)
            for j in range(4):
                y = 3.5 * j
                self.rectangle([x, y + 3.5, HEIGHT_M], [BAY_M, 0, 0], [0, -3.5, 0], "concrete",
                               rgb=_WHITE, tie_m=0.55, detail=0.7)  # fmt: skip
            self.box([x - 0.1, 0, 4.3], [x + 0.1, CORRIDOR_Y_M, HEIGHT_M], "metal",
                     faces=("-x", "+x", "-z"), rgb=_WHITE, detail=0.7)  # fmt: skip
            for y in (2.0, 6.9, 10.6):  # strip lights between the trays
                self.box([x + 0.7, y - 0.1, 4.4], [x + 2.0, y + 0.1, 4.5], "metal", rgb=_WHITE)
                self.lamps.append((x + 1.35, y, 4.38))

    def south(self) -> None:
        """Parapet, windows and lintel, bay after bay."""
        for k in range(8):
            x = BAY_M * k
            self.box([x, -0.3, 0], [x + BAY_M, 0, 0.9], "concrete", faces=("+y", "+z"))
            self.box([x, -0.3, 3.5], [x + BAY_M, 0, HEIGHT_M], "plaster", faces=("+y", "-z"),
                     rgb=_WHITE)  # fmt: skip
            self.box([x, -0.3, 0.9], [x + 0.35, 0, 3.5], "plaster", faces=("+y", "-x", "+x"),
                     rgb=_SAND)  # fmt: skip
            for m in (x + 1.5, x + 2.69):
                self.box([m, -0.2, 0.9], [m + 0.06, -0.12, 3.5], "metal", rgb=_DARK)
            for z in (0.9, 2.7, 3.44):
                self.box([x + 0.35, -0.2, z], [x + BAY_M, -0.12, z + 0.06], "metal", rgb=_DARK)
            self.box([x + 0.5, 0, 0.15], [x + 2.5, 0.12, 0.7], "metal", faces=OPEN, rgb=_WHITE)
        self.walls((-0.3, -0.3, LENGTH_M + 0.3, 0))

    def corridor(self) -> None:
        """Equal doors with equal notices between them, behind a low wall and posts."""
        y = WIDTH_M
        for k in range(8):
            x = BAY_M * k
            rgb = _SAND if k % 2 else _WHITE
            self.rectangle([x, y, 0], [BAY_M, 0, 0], [0, 0, HEIGHT_M], "plaster", rgb=rgb)
            self.rectangle([x + 0.5, y - 0.03, 0], [0.95, 0, 0], [0, 0, 2.1], "door",
                           text=f"0.{k + 1:02d}")  # fmt: skip
            for a in (x + 0.42, x + 1.45):
                self.box([a, y - 0.06, 0], [a + 0.08, y, 2.18], "wood", upright=True,
                         faces=("-y", "-x", "+x"))  # fmt: skip
            self.sign(f"notice-{k}", [x + 1.75, y - 0.02, 1.2], [0.7, 0, 0], [0, 0, 0.95], "NOTICE")
            text = ("SAFETY", "PLAN", "NEWS", "TEAM")[k % 4]
            self.rectangle([x + 0.7, y - 0.02, 2.5], [1.3, 0, 0], [0, 0, 1.7], "poster",
                           text=text, detail=1.4)  # fmt: skip
            self.box([x, CORRIDOR_Y_M - 0.05, 0], [x + 1.9, CORRIDOR_Y_M + 0.05, 1.1], "wood",
                     faces=OPEN, rgb=(0.30, 0.22, 0.14), plank_m=0.12)  # fmt: skip
            low, high = CORRIDOR_Y_M - 0.12, CORRIDOR_Y_M + 0.12
            self.box([x - 0.12, low, 0], [x + 0.12, high, HEIGHT_M], "concrete",
                     faces=("-x", "+x", "-y", "+y"), rgb=_GREEN)  # fmt: skip
            self.walls((x, CORRIDOR_Y_M - 0.05, x + 1.9, CORRIDOR_Y_M + 0.05))
        self.walls((-0.3, y, LENGTH_M + 0.3, y + 0.3))

    def rooms(self) -> None:
        """At each end a wall with a long opening and a doorway, and a room behind."""
        for x, out, rgb in ((ROOMS_X_M[0], 1.0, _GREEN), (ROOMS_X_M[1], -1.0, _SAND)):
            a, c = x - 0.05, x + 0.05
            pieces = (
                (0.0, 2.6, 0.0, HEIGHT_M), (2.6, 7.6, 0.0, 0.95), (2.6, 7.6, 2.8, HEIGHT_M),
                (7.6, 9.2, 0.0, HEIGHT_M), (9.2, 10.2, 2.2, HEIGHT_M), (10.2, 12.1, 0.0, HEIGHT_M),
            )  # fmt: skip
            for y0, y1, z0, z1 in pieces:
                self.box([a, y0, z0], [c, y1, z1], "plaster", rgb=rgb, dirt=0.2)
                if z0 == 0.0:
                    self.walls((a, y0, c, y1))
            for y in (2.6, 4.2, 5.8, 7.54):
                self.box([a, y, 0.95], [c, y + 0.06, 2.8], "metal", rgb=_DARK)
            face = c + 0.01 if out > 0 else a - 0.01
            for y, text in ((0.7, "KITCHEN"), (8.0, "PRINT"), (10.6, "MEETING")):
                start = y if out > 0 else y + 1.1  # upright text reads along +u
                name = f"sign-{text.lower()}-{'w' if out > 0 else 'e'}"
                self.sign(name, [face, start, 1.5], [0, 1.1 * out, 0], [0, 0, 1.5], text)
            end = 0.0 if out > 0 else LENGTH_M
            u = 3.5 * out
            for k in range(4):
                y = 3.5 * (k if out > 0 else k + 1)
                self.rectangle([end, y, 0], [0, u, 0], [0, 0, HEIGHT_M], "brick", detail=1.1)
            for y in (0.6, 3.0, 5.4, 10.4):
                lo, hi = sorted((end + 0.02 * out, end + 0.45 * out))
                self.stand([lo, y, 0], [hi, y + 1.6, 2.0], "wood", faces=OPEN, upright=True)
            self.walls((-0.3, 0, 0, WIDTH_M) if out > 0 else (22.0, 0, 22.3, WIDTH_M))

    def desks(self) -> None:
        """Equal desks in rows, screens and cupboards on them; nothing reaches 1.5 m."""
        for x in (3.2, 6.4, 9.6, 12.8, 16.0):
            for y in (1.6, 5.0, 8.4):
                self.stand([x, y, 0.68], [x + 1.8, y + 1.6, 0.74], "wood", faces=OPEN,
                           rgb=(0.50, 0.40, 0.27))  # fmt: skip
                self.box([x, y + 0.78, 0.74], [x + 1.8, y + 0.82, 1.2], "fabric", faces=OPEN,
                         rgb=_BLUE if int(x + y) % 2 else _GREEN)  # fmt: skip
                for dy in (0.5, 1.02):
                    self.box([x + 0.5, y + dy, 0.85], [x + 1.1, y + dy + 0.06, 1.22], "metal",
                             faces=OPEN, rgb=_DARK)  # fmt: skip
                self.rectangle([x + 0.15, y + 0.1, 0.745], [0.3, 0, 0], [0, 0.42, 0], "poster",
                               text="MEMO", detail=1.6)  # fmt: skip
                self.box([x + 1.3, y + 0.1, 0], [x + 1.7, y + 0.7, 0.68], "metal", faces=OPEN,
                         rgb=_WHITE)  # fmt: skip
                self.box([x + 0.5, y - 0.65, 0.4], [x + 1.0, y - 0.15, 0.5], "fabric", rgb=_DARK)
        for x, y in ((2.3, 10.8), (8.6, 4.2), (15.1, 7.6), (18.9, 10.9), (18.9, 0.7)):
            self.stand([x, y, 0], [x + 0.5, y + 0.5, 0.5], "concrete", faces=OPEN, rgb=_SLATE)
            self.box([x + 0.05, y + 0.05, 0.5], [x + 0.45, y + 0.45, 1.1], "foliage", faces=OPEN)

    def outside(self) -> None:
        """What the windows show: a car park, a hedge, the sky."""
        self.rectangle([-16, -14, 0], [54, 0, 0], [0, 13.7, 0], "concrete", detail=0.15,
                       outside=True)  # fmt: skip
        for k in range(6):
            x = 9.0 * k - 16
            self.rectangle([x + 9, -13.9, -0.5], [-9, 0, 0], [0, 0, 3.0 + 0.9 * (k % 3)],
                           "foliage", detail=0.4, zoom=1.1, outside=True)  # fmt: skip
            self.rectangle([x + 9, -14, 0], [-9, 0, 0], [0, 0, 14], "sky", detail=0.25,
                           outside=True)  # fmt: skip
        for x, along in ((-16.0, 1.0), (38.0, -1.0)):  # to the sides
            y = -14.0 if along > 0 else 0.0
            self.rectangle([x + 0.1 * along, y, -0.5], [0, 14.0 * along, 0], [0, 0, 4.0],
                           "foliage", detail=0.4, zoom=1.1, outside=True)  # fmt: skip
            self.rectangle([x, y, 0], [0, 14.0 * along, 0], [0, 0, 14], "sky", detail=0.25,
                           outside=True)  # fmt: skip


def build_office(texels_per_m: float) -> Scene:
    """The scene `office`."""
    o = _Office(texels_per_m)
    for part in (o.floor_and_ceiling, o.south, o.corridor, o.rooms, o.desks, o.outside):
        part()
    return o.scene("office", (LENGTH_M, WIDTH_M, HEIGHT_M), TEXTURE_SEED)
