"""The atrium: a hall of 24 x 16 x 9 m after the thesis's, full of things that repeat.

x runs east along the floor plan's horizontal axis, y north, z up; the origin is the hall's
south-west corner on the floor. South: glass doors under a row of windows. North: a balcony on
pillars, doors above and below. West: chequered panels. East: brick, and stairs to the balcony.
"""

from __future__ import annotations

import numpy as np

from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.scene import Footprint, KnownPoint, Scene

LENGTH_M, WIDTH_M, HEIGHT_M = 24.0, 16.0, 9.0
BAY_M = 3.0
BALCONY_Y_M, BALCONY_Z_M, SLAB_M = 13.0, 3.6, 0.3
SOUTH_PILLARS_Y_M, NORTH_PILLARS_Y_M = 2.2, 13.3
PILLARS_X_M = tuple(BAY_M * k + 1.5 for k in range(8))
PILLAR_RADIUS_M = 0.26
TEXTURE_SEED = 20131

_CREAM, _WHITE, _OCHRE = (0.60, 0.54, 0.43), (0.70, 0.69, 0.65), (0.52, 0.36, 0.16)
_TEAL, _RED, _GREY = (0.10, 0.28, 0.28), (0.42, 0.09, 0.07), (0.36, 0.36, 0.37)


MOVED_M = 1.2
"""How far furniture has been moved at most, along x and y, where it has been."""
_MOVED_SEED = 5


class _Atrium(SceneBuilder):
    def __init__(self, texels_per_m: float, *, moved: float, posted: bool) -> None:
        super().__init__(texels_per_m)
        self.moved, self.posted = moved, posted
        self._places = np.random.default_rng(_MOVED_SEED)
        self._pieces = np.random.default_rng(_MOVED_SEED + 1)

    def placed(self, x: float, y: float) -> tuple[float, float]:
        """Where a piece of furniture stands that was at (x, y) when the hall was mapped."""
        dx, dy = self._places.uniform(-MOVED_M, MOVED_M, 2).tolist()
        stays = self._pieces.random() >= self.moved
        return (x, y) if stays else (x + dx, y + dy)

    def poster(self, name: str, origin: list[float], u: list[float], v: list[float]) -> None:
        """A poster with two of its corners surveyed (they stand out from the wall by the sign)."""
        edition = {"edition": 1} if self.posted else {}
        self.sign(f"sign-{name.lower()}", origin, u, v, name, **edition)

    def floor_and_ceiling(self) -> None:
        for i in range(8):
            for j in range(4):
                self.rectangle(
                    [3 * i, 4 * j, 0], [3, 0, 0], [0, 4, 0], "terrazzo", slab_m=1.0, detail=0.9
                )
        # The inlay: a border of darker slabs around the middle of the hall.
        for left, low, w, h in (
            (5, 5, 14, 0.4),
            (5, 10.6, 14, 0.4),
            (5, 5.4, 0.4, 5.2),
            (18.6, 5.4, 0.4, 5.2),
        ):
            self.rectangle(
                [left, low, 0.004], [w, 0, 0], [0, h, 0], "terrazzo", slab_m=0.4,
                rgb=(0.2, 0.13, 0.1), detail=0.9,
            )  # fmt: skip
        for i in range(12):
            for j in range(8):
                x, y, z = 2.0 * i, 2.0 * j, HEIGHT_M
                if i in (2, 4, 7, 9) and j in (2, 3, 4):
                    self.rooflight(x, y, z, 2, 0.5, _WHITE)
                    for k in (0.66, 1.33):
                        self.box(
                            [x + k - 0.03, y, z + 0.3], [x + k + 0.03, y + 2, z + 0.4], "metal",
                            rgb=_WHITE,
                        )  # fmt: skip
                else:
                    self.rectangle(
                        [x, y + 2, z], [2, 0, 0], [0, -2, 0], "concrete", tie_m=1.0, detail=0.6
                    )
        for i in range(9):
            beam = float(np.clip(BAY_M * i, 0.15, LENGTH_M - 0.15))
            self.box(
                [beam - 0.15, 0, 8.45], [beam + 0.15, WIDTH_M, HEIGHT_M], "wood",
                faces=("-x", "+x", "-z"), detail=0.6, plank_m=0.28,
            )  # fmt: skip
        for along in (4.0, 12.0):
            self.box(
                [0, along - 0.1, 8.6], [LENGTH_M, along + 0.1, HEIGHT_M], "wood",
                faces=("-y", "+y", "-z"), detail=0.5, plank_m=0.2,
            )  # fmt: skip

    def south(self) -> None:
        """Glass doors under windows, bay after bay, with piers of painted concrete between."""
        for k in range(8):
            x = BAY_M * k
            a, c = x + 0.4, x + BAY_M - 0.4
            for lo, hi in ((x, a), (c, x + BAY_M)):
                self.box([lo, -0.3, 0], [hi, 0, HEIGHT_M], "concrete", faces=("+y", "-x", "+x"))
            self.box([a, -0.3, 2.6], [c, 0, 4.0], "plaster", rgb=_CREAM)
            self.box([a, -0.3, 7.6], [c, 0, HEIGHT_M], "plaster", rgb=_CREAM)
            for z0, z1, bars in ((0.0, 2.6, (0.0, 2.1, 2.54)), (4.0, 7.6, (4.0, 5.2, 6.4, 7.54))):
                for m in (a, (a + c) / 2 - 0.03, c - 0.06):
                    self.box([m, -0.18, z0], [m + 0.06, -0.10, z1], "metal", rgb=(0.13, 0.14, 0.15))
                for z in bars:
                    self.box([a, -0.17, z], [c, -0.11, z + 0.06], "metal", rgb=(0.13, 0.14, 0.15))
            for m in ((a + c) / 2 - 0.25, (a + c) / 2 + 0.2):  # handles
                self.box([m, -0.09, 0.9], [m + 0.04, -0.05, 1.4], "metal", rgb=(0.6, 0.6, 0.6))
            self.walls((x, -0.3, a, 0), (c, -0.3, x + BAY_M, 0))
            self.footprints.append(Footprint((a, -0.17, c, -0.11), "glass"))
        for k, text in ((1, "EXIT"), (4, "INFO"), (6, "CAFE")):
            x = BAY_M * k + 0.95
            self.poster(text, [x + 1.1, 0.02, 2.72], [-1.1, 0, 0], [0, 0, 1.15])

    def west(self) -> None:
        """The chequered wall: panels of 1.5 m, equal but for their stains."""
        for j in range(10):
            for k in range(6):
                rgb = _OCHRE if (j + k) % 2 else _WHITE
                y, z = 1.6 * j, 1.5 * k
                panel = self.rectangle(
                    [0, y, z], [0, 1.6, 0], [0, 0, 1.5], "plaster", rgb=rgb, dirt=0.22
                )
                if (j, k) in ((2, 2), (7, 2), (2, 4), (7, 4), (4, 1)):
                    self.survey(f"panel-{j}-{k}", panel, 0)
        for y in range(1, 10):
            self.box([0, 1.6 * y - 0.02, 0], [0.02, 1.6 * y + 0.02, HEIGHT_M], "metal",
                     faces=("+x",), rgb=(0.2, 0.2, 0.2))  # fmt: skip
        for y, z, text in ((3.4, 1.3, "PHYSICS"), (7.0, 1.5, "LIBRARY"), (10.8, 4.4, "ROBOTICS")):
            self.poster(text, [0.03, y, z], [0, 1.5, 0], [0, 0, 2.0])
        self.walls((-0.3, -0.3, 0, WIDTH_M + 0.3))

    def east(self) -> None:
        """Brick, with stairs along it up to the balcony."""
        for j in range(4):
            for k in range(3):
                self.rectangle([24, 4 * j + 4, 3 * k], [0, -4, 0], [0, 0, 3.0], "brick", detail=1.1)
        for y, z, text in ((7.2, 5.3, "HALL B"), (11.6, 5.6, "OPEN DAY"), (3.6, 1.4, "CONCERT")):
            self.poster(text, [23.97, y, z], [0, -1.4, 0], [0, 0, 1.9])
        steps, y0 = 20, 7.0
        rise, run = BALCONY_Z_M / steps, (BALCONY_Y_M - y0) / steps
        for s in range(steps):
            y, z = y0 + run * s, rise * (s + 1)
            self.box([22.2, y, z - 0.05], [24, y + run, z], "wood", faces=("+z", "-y", "-x"))
            self.box(
                [22.25, y + 0.02, z - rise],
                [23.95, y + 0.05, z - 0.05],
                "concrete",
                faces=("-y", "-x"),
            )
            self.box([22.2, y, max(0, z - 0.45)], [22.26, y + run, z - 0.05], "metal", rgb=_GREY,
                     faces=("-x", "-z"))  # fmt: skip
            if s % 3 == 0:
                self.box([22.2, y, z], [22.24, y + 0.04, z + 1.0], "metal", rgb=_TEAL)
        for offset in (0.55, 1.0):  # the sloping rails, as short pieces
            for s in range(steps):
                y, z = y0 + run * s, rise * (s + 1) + offset
                self.box([22.2, y, z - 0.03], [22.25, y + run, z + 0.03], "metal", rgb=_TEAL)
        self.walls((24, -0.3, 24.3, WIDTH_M + 0.3))
        self.footprints.append(Footprint((22.2, y0, 24, BALCONY_Y_M), "stairs"))

    def north(self) -> None:
        """The balcony, its handrail and pillars, and equal doors on both floors."""
        y1 = WIDTH_M
        for k in range(8):
            x = BAY_M * k
            for z0, z1, rgb, floor in (
                (0.0, BALCONY_Z_M - SLAB_M, _CREAM, 1),
                (BALCONY_Z_M, 9.0, _WHITE, 2),
            ):
                self.rectangle([x, y1, z0], [3, 0, 0], [0, 0, z1 - z0], "plaster", rgb=rgb)
                number = f"{floor}.{k + 1:02d}"
                if (k, floor) not in ((3, 1), (6, 1)):
                    self.rectangle(
                        [x + 0.9, y1 - 0.03, z0], [1.1, 0, 0], [0, 0, 2.2], "door", text=number
                    )
                for left, right in ((0.8, 0.9), (2.0, 2.1)):
                    self.box([x + left, y1 - 0.06, z0], [x + right, y1, z0 + 2.3], "wood",
                             upright=True, faces=("-y", "-x", "+x"))  # fmt: skip
            # Under the balcony, wainscot and a notice in every bay.
            for a, c in ((x, x + 0.8), (x + 2.1, x + 3)):
                self.box([a, y1 - 0.04, 0], [c, y1, 1.05], "wood", faces=("-y", "+z"),
                         upright=True, plank_m=0.1, rgb=(0.25, 0.16, 0.10))  # fmt: skip
            self.rectangle([x + 2.25, y1 - 0.02, 1.4], [0.55, 0, 0], [0, 0, 0.75], "poster",
                           text="NOTICE", detail=1.6)  # fmt: skip
            # A frieze of chequers above the upper doors.
            for q in range(4):
                for row, z in enumerate((7.2, 7.95)):
                    self.rectangle(
                        [x + 0.75 * q, y1 - 0.01, z], [0.75, 0, 0], [0, 0, 0.75], "plaster",
                        rgb=_TEAL if (q + k + row) % 2 else _OCHRE,
                    )  # fmt: skip
            # The slab.
            self.rectangle([x, 13, BALCONY_Z_M], [3, 0, 0], [0, 3, 0], "wood", detail=0.7)
            self.rectangle(
                [x, y1, BALCONY_Z_M - SLAB_M],
                [3, 0, 0],
                [0, -3, 0],
                "concrete",
                tie_m=1.0,
                detail=0.8,
            )
            fascia = self.rectangle(
                [x, 13, BALCONY_Z_M - SLAB_M], [3, 0, 0], [0, 0, SLAB_M], "concrete", rgb=_WHITE
            )
            if k in (2, 5):
                self.survey(f"slab-{k}", fascia, 0)
            # The handrail.
            gap = x >= 21  # where the stairs arrive
            for q in range(0 if not gap else 4, 4):
                px = x + 0.75 * q
                self.box(
                    [px - 0.025, 13.03, BALCONY_Z_M], [px + 0.025, 13.08, 4.7], "metal", rgb=_TEAL
                )
            if not gap:
                for z, t in ((4.66, 0.04), (4.40, 0.02), (4.15, 0.02), (3.90, 0.02)):
                    self.box([x, 13.03, z], [x + 3, 13.03 + 2 * t, z + 2 * t], "metal", rgb=_TEAL)
        for k, text in ((3, "LECTURE 1"), (6, "ARCHIVE")):
            self.poster(text, [BAY_M * k + 0.7, y1 - 0.02, 0.7], [1.5, 0, 0], [0, 0, 2.0])
        for x, text in ((5.35, "SUMMER"), (11.3, "MUSEUM"), (17.4, "THEATRE")):
            self.poster(text, [x, y1 - 0.02, 4.9], [1.3, 0, 0], [0, 0, 1.9])
        # Banners hang from the balcony, in front of its slab.
        for x, text in ((7.6, "WELCOME"), (16.6, "AIRSHIPS")):
            self.poster(text, [x, 12.96, 2.2], [1.8, 0, 0], [0, 0, 1.3])
        self.walls((-0.3, WIDTH_M, LENGTH_M + 0.3, WIDTH_M + 0.3))
        self.footprints.append(Footprint((0, BALCONY_Y_M, LENGTH_M, WIDTH_M), "balcony"))

    def pillars(self) -> None:
        """Two rows of equal pillars: the southern up to the roof, the northern to the balcony."""
        for k, x in enumerate(PILLARS_X_M):
            for y, top in ((SOUTH_PILLARS_Y_M, 8.45), (NORTH_PILLARS_Y_M, BALCONY_Z_M - SLAB_M)):
                self.prism(
                    (x, y), PILLAR_RADIUS_M, (0.3, top), 10, "concrete", rgb=(0.55, 0.53, 0.49),
                    band=(1.2, 1.5, _RED),
                )  # fmt: skip
                r = PILLAR_RADIUS_M + 0.08
                self.box([x - r, y - r, 0], [x + r, y + r, 0.3], "concrete", rgb=_GREY)
                self.box([x - r, y - r, top - 0.25], [x + r, y + r, top], "concrete", rgb=_GREY)
                self.footprints.append(Footprint((x - r, y - r, x + r, y + r), "pillar", disc=True))
                if k in (1, 3, 6):
                    side = r if y < 8 else -r
                    row = "s" if y < 8 else "n"
                    normal = (0.0, float(np.sign(side)), 0.0)
                    self.known.append(KnownPoint(f"base-{row}-{k}", (x - r, y + side, 0.3), normal))

    def furniture(self) -> None:
        for x, y in ((6.5, 4.0), (11.0, 4.0), (15.5, 4.0), (6.5, 11.6), (11.0, 11.6), (15.5, 11.6)):
            x, y = self.placed(x, y)
            self.stand([x, y, 0.35], [x + 2.0, y + 0.5, 0.45], "wood")  # benches
            for q in (0.1, 1.75):
                self.box([x + q, y + 0.05, 0], [x + q + 0.12, y + 0.45, 0.35], "metal")
        for x, y, rgb in ((8.2, 7.2, _TEAL), (13.6, 7.4, _RED)):  # sofas back to back
            x, y = self.placed(x, y)
            self.stand([x, y, 0], [x + 1.9, y + 0.9, 0.42], "fabric", faces=OPEN, rgb=rgb)
            self.box([x, y + 0.35, 0.42], [x + 1.9, y + 0.55, 0.85], "fabric", faces=OPEN, rgb=rgb)
            self.stand(
                [x + 2.2, y + 0.1, 0.42], [x + 3.0, y + 0.8, 0.48], "wood", faces=(*OPEN, "-z")
            )
            self.box([x + 2.55, y + 0.4, 0], [x + 2.65, y + 0.5, 0.42], "metal")
        self.stand([19.6, 8.2, 0], [20.4, 10.8, 1.1], "wood", faces=OPEN, upright=True)  # reception
        self.box([19.5, 8.1, 1.1], [20.5, 10.9, 1.16], "terrazzo", slab_m=0.6, rgb=_GREY)
        for x, y in ((3.2, 4.6), (3.2, 11.2), (20.6, 4.2), (10.6, 9.6), (12.9, 5.6), (5.2, 8.0)):
            x, y = self.placed(x, y)
            self.stand(
                [x, y, 0], [x + 0.6, y + 0.6, 0.55], "concrete", faces=OPEN, rgb=_GREY
            )  # planters
            for dx, dy, z0, z1 in (
                (0.0, 0.0, 0.55, 1.0),
                (0.1, 0.1, 1.0, 1.35),
                (0.2, 0.15, 1.35, 1.6),
            ):
                self.box(
                    [x + dx, y + dy, z0], [x + 0.6 - dx, y + 0.6 - dy, z1], "foliage", faces=OPEN
                )
        for x, text in ((9.7, "MAP"), (14.4, "TODAY")):  # notice boards on the floor, two sided
            lo, hi = [x, 8.9, 0.0], [x + 0.9, 9.0, 1.9]
            self.stand(lo, hi, "metal", faces=OPEN, rgb=(0.2, 0.2, 0.22))
            self.poster(text, [x + 0.05, 8.89, 0.5], [0.8, 0, 0], [0, 0, 1.3])
            self.rectangle([x + 0.85, 9.01, 0.5], [-0.8, 0, 0], [0, 0, 1.3], "poster",
                           text=text, detail=1.6)  # fmt: skip
        for k, x in enumerate((1.2, 4.4, 17.6, 20.8)):  # cupboards under the balcony
            self.stand([x, 15.4, 0], [x + 0.9, 15.98, 1.9], "metal", faces=OPEN,
                  rgb=((0.35, 0.33, 0.28), _GREY)[k % 2])  # fmt: skip
        for x in (3.0, 9.0, 15.0, 21.0):  # pendant lamps on rods
            for y in (5.0, 11.0):
                self.box([x - 0.01, y - 0.01, 6.5], [x + 0.01, y + 0.01, 8.9], "metal")
                self.prism((x, y), 0.28, (6.2, 6.5), 8, "metal", rgb=_WHITE)
                self.rectangle(
                    [x - 0.2, y + 0.2, 6.2], [0.4, 0, 0], [0, -0.4, 0], "metal", rgb=_WHITE
                )
                self.rectangle(
                    [x - 0.2, y - 0.2, 6.5], [0.4, 0, 0], [0, 0.4, 0], "metal", rgb=_WHITE
                )
                self.lamps.append((x, y, 6.1))
        for x in (3.0, 9.0, 15.0, 21.0):
            self.lamps.append((x, 14.6, 3.2))

    def outside(self) -> None:
        """What the windows show: pavement, trees, the sky."""
        for k in range(8):
            x = 8.0 * k - 20
            self.rectangle(
                [x, -14, 0], [8, 0, 0], [0, 14.0, 0], "concrete", detail=0.15, outside=True
            )
            self.rectangle(
                [x + 8, -13.9, -0.5], [-8, 0, 0], [0, 0, 4.0 + 1.3 * ((3 * k) % 4)], "foliage",
                detail=0.4, zoom=1.2, outside=True,
            )  # fmt: skip
            self.rectangle(
                [x + 8, -14, 0], [-8, 0, 0], [0, 0, 18], "sky", detail=0.25, outside=True
            )
        for x, along in ((-19.9, 1.0), (43.9, -1.0)):
            y0 = -14.0 if along > 0 else 0.0
            self.rectangle(
                [x, y0, -0.5], [0, 14.0 * along, 0], [0, 0, 5.5], "foliage", detail=0.4, zoom=1.2,
                outside=True,
            )  # fmt: skip
            self.rectangle(
                [x - 0.1 * along, y0, -0.5],
                [0, 14.0 * along, 0],
                [0, 0, 18],
                "sky",
                detail=0.25,
                outside=True,
            )
        self.rectangle([-6, 20, 14], [36, 0, 0], [0, -26, 0], "sky", detail=0.2, outside=True)


def build_atrium(texels_per_m: float, *, moved: float = 0.0, posted: bool = False) -> Scene:
    """The scene `atrium`.

    A share `moved` of benches, sofas and plants stands up to `MOVED_M` elsewhere; `posted`: other
    posters hang in the old ones' places. That is the hall some time after it was mapped.
    """
    a = _Atrium(texels_per_m, moved=moved, posted=posted)
    for part in (
        a.floor_and_ceiling, a.south, a.west, a.east, a.north, a.pillars, a.furniture, a.outside,
    ):  # fmt: skip
        part()
    share = "" if moved == 1 else f"-{100 * moved:.0f}"
    name = "atrium" + f"-moved{share}" * (moved > 0) + "-posted" * posted
    return a.scene(name, (LENGTH_M, WIDTH_M, HEIGHT_M), TEXTURE_SEED)
