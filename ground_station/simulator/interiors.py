"""Procedural interiors, built of the simulator's surfaces: some to learn from, others to judge in.

`build_room` is what training sees. `build_interior` is what localizers are judged in: of other
materials, with prints that repeat, blank bays, screens, and a way kept free for who walks or flies
round it. Reflections are not simulated: what is glossy shines alike from all sides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.scene import Footprint, Scene, SimulatorError, Surface

Rng = np.random.Generator


class _Room(SceneBuilder):
    """A box of random size, cut into bays; every wall, window and thing in it random."""

    WALLS: tuple[str, ...] = ("plaster", "plaster", "brick", "concrete", "wood")
    FLOORS: tuple[str, ...] = ("terrazzo", "wood", "concrete")
    SOLIDS: tuple[str, ...] = ("wood", "metal", "fabric", "concrete", "plaster", "foliage")
    ABOVE = "concrete"
    GLAZED = 0.5
    """Of the walls: windows in most of their bays."""
    OUTSIDE = 0.4
    """Detail of the hedges, which are seen from afar."""

    def __init__(self, rng: Rng, texels_per_m: float) -> None:
        super().__init__(texels_per_m)
        self.rng = rng
        self.size = self._size()
        self.bay = float(rng.uniform(1.6, 3.6))
        self.colours = [self._colour() for _ in range(5)]
        self.material = str(rng.choice(self.WALLS))

    def _size(self) -> tuple[float, float, float]:
        rng = self.rng
        return float(rng.uniform(6, 17)), float(rng.uniform(5, 12)), float(rng.uniform(3, 7))

    def _colour(self) -> tuple[float, ...]:
        grey = np.exp(self.rng.uniform(np.log(0.08), np.log(0.75)))
        return tuple(np.clip(grey * (1 + 0.3 * self.rng.standard_normal(3)), 0.04, 0.85).tolist())

    def _rgb(self) -> tuple[float, ...]:
        return self.colours[int(self.rng.integers(len(self.colours)))]

    def floor_and_ceiling(self) -> None:
        """Slabs or planks below, panels above, some of them open to the sky."""
        length, width, height = self.size
        floor = str(self.rng.choice(self.FLOORS))
        step, rgb = float(self.rng.uniform(2.5, 5)), self._rgb()
        options: dict[str, Any] = {"slab_m": float(self.rng.uniform(0.3, 1.2))}
        for x, w in _pieces(length, step):
            for y, h in _pieces(width, step):
                self.rectangle([x, y, 0], [w, 0, 0], [0, h, 0], floor, rgb=rgb, **options)
                if self.rng.random() < 0.12:  # a rooflight
                    continue
                self.rectangle([x, y + h, height], [w, 0, 0], [0, -h, 0], self.ABOVE,
                               rgb=self._rgb(), tie_m=0.8, detail=0.6)  # fmt: skip
            if self.rng.random() < 0.6:
                self.box([x - 0.1, 0, height - 0.3], [x + 0.1, width, height], "wood",
                         faces=("-x", "+x", "-z"), detail=0.6)  # fmt: skip

    def sides(self) -> None:
        """Four walls in bays: blank, with a window, a door or signs."""
        length, width, _ = self.size
        corners = ((0, 0, length), (length, 0, width), (length, width, length), (0, width, width))
        ways = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        for (x, y, run), (ux, uy) in zip(corners, ways, strict=True):
            glazed = self.rng.random() < self.GLAZED
            for start, wide in _pieces(run, self.bay):
                # Fronts look into the room: u runs the other way round.
                origin = np.array([x + ux * (start + wide), y + uy * (start + wide), 0.0])
                self._bay(origin, np.array([-ux, -uy, 0.0]), wide, glazed)

    def _bay(self, origin: F64, u: F64, wide: float, glazed: bool) -> None:
        height = self.size[2]
        rgb, up = self._rgb(), np.array([0.0, 0.0, 1.0])
        inward = np.cross(u, up)

        def panel(left: float, low: float, w: float, h: float, material: str, **o: Any) -> Surface:
            place = origin + u * left + up * low + inward * float(o.pop("off", 0.0))
            return self.rectangle(place, u * w, up * h, material, **o)

        draw = self.rng.random()
        if glazed and draw < 0.75 and wide > 1.2:
            sill, top = 0.9, min(height - 0.4, float(self.rng.uniform(2.2, 3.4)))
            panel(0, 0, wide, sill, self.material, rgb=rgb)
            panel(0, top, wide, height - top, self.material, rgb=rgb)
            panel(0, sill, 0.3, top - sill, self.material, rgb=rgb)
            panel(wide - 0.3, sill, 0.3, top - sill, self.material, rgb=rgb)
            dark = (0.12, 0.12, 0.13)
            self._survey(panel(wide / 2 - 0.03, sill, 0.06, top - sill, "metal", rgb=dark))
            panel(0.3, (sill + top) / 2, wide - 0.6, 0.06, "metal", rgb=dark)
            return
        material = self.material if self.rng.random() < 0.7 else str(self.rng.choice(self.WALLS))
        panel(0, 0, wide, height, material, rgb=rgb)
        self._hang(panel, wide, draw)

    def _survey(self, surface: Surface) -> None:
        """Makes something in a bay a place that a person can click and measure."""

    def _hang(self, panel: Callable[..., Surface], wide: float, draw: float) -> None:
        """What hangs in a bay: a door, signs, or nothing."""
        height = self.size[2]
        if draw > 0.85 and wide > 1.5:
            panel(0.3, 0, 0.95, 2.1, "door", text=self._word(), off=0.03)
        elif draw > 0.3:
            for _ in range(int(self.rng.integers(1, 4))):
                w, h = float(self.rng.uniform(0.35, 0.6 * wide)), float(self.rng.uniform(0.4, 1.4))
                left = float(self.rng.uniform(0.05, max(0.06, wide - w - 0.05)))
                low = float(self.rng.uniform(0.4, max(0.5, height - h - 0.3)))
                off = float(self.rng.uniform(0.01, 0.05))
                panel(left, low, w, h, "poster", text=self._word(), off=off, detail=1.5)

    def _word(self) -> str:
        letters = list("ABCDEFGHIKLMNOPRSTUVW0123456789")
        return "".join(self.rng.choice(letters, int(self.rng.integers(2, 9))).tolist())

    def things(self) -> None:
        """Tables, cupboards, boards, plants; pillars up to the ceiling."""
        length, width, height = self.size
        for _ in range(int(self.rng.integers(5, 22))):
            w, d = self.rng.uniform(0.3, 2.0), self.rng.uniform(0.05, 1.2)
            if self.rng.random() < 0.5:
                w, d = d, w
            x, y = self.rng.uniform(0.3, length - w - 0.3), self.rng.uniform(0.3, width - d - 0.3)
            low = 0.0 if self.rng.random() < 0.7 else float(self.rng.uniform(0.3, 0.8))
            high = low + float(self.rng.uniform(0.1, 1.7))
            material = str(self.rng.choice(self.SOLIDS))
            faces = (*OPEN, "-z") if low > 0 else OPEN
            self.box([x, y, low], [x + w, y + d, high], material, faces=faces, rgb=self._rgb())
            if w > 0.5 and self.rng.random() < 0.4:
                self.rectangle([x + 0.05, y + 0.05, high + 0.003], [w - 0.1, 0, 0],
                               [0, max(0.1, d - 0.1), 0], "poster",
                               text=self._word())  # fmt: skip
        for _ in range(int(self.rng.integers(0, 6))):
            centre = (float(self.rng.uniform(1, length - 1)), float(self.rng.uniform(1, width - 1)))
            self.prism(centre, float(self.rng.uniform(0.12, 0.4)), (0, height),
                       int(self.rng.integers(4, 12)), "concrete", rgb=self._rgb(),
                       band=(1.1, 1.4, self._rgb()))  # fmt: skip

    def outside(self) -> None:
        """Sky, hedges and ground beyond the windows, on all sides."""
        length, width, height = self.size
        far = 8.0
        self.rectangle([-far, -far, -0.02], [length + 2 * far, 0, 0], [0, width + 2 * far, 0],
                       "concrete", detail=0.15, outside=True)  # fmt: skip
        sides = (
            ([length + far, -far, 0], [-length - 2 * far, 0, 0]),
            ([length + far, width + far, 0], [0, -width - 2 * far, 0]),
            ([-far, width + far, 0], [length + 2 * far, 0, 0]),
            ([-far, -far, 0], [0, width + 2 * far, 0]),
        )
        for origin, u in sides:
            self.rectangle(origin, u, [0, 0, 14], "sky", detail=0.25, outside=True)
            near = 0.98 * np.asarray(origin) + 0.02 * np.array([length / 2, width / 2, 0])
            self.rectangle(near, 0.98 * np.asarray(u), [0, 0, float(self.rng.uniform(2, 5))],
                           "foliage", detail=self.OUTSIDE, zoom=1.2, outside=True)  # fmt: skip
        self.rectangle([-far, width + far, height + 6], [length + 2 * far, 0, 0],
                       [0, -width - 2 * far, 0], "sky", detail=0.2, outside=True)  # fmt: skip


def _pieces(length: float, step: float) -> list[tuple[float, float]]:
    """Equal pieces of about `step`: (start, length) of each."""
    count = max(1, round(length / step))
    return [(k * length / count, length / count) for k in range(count)]


class _Interior(_Room):
    """What localizers are judged in, with prints of a few plates and a free way round."""

    WALLS = ("tiles", "wallpaper", "laminate", "laminate", "panelling")
    FLOORS = ("carpet", "tiles", "laminate")
    SOLIDS = ("laminate", "panelling", "carpet", "screen")
    ABOVE = "panelling"
    OUTSIDE = 0.25
    SIZES_M: tuple[tuple[float, float, float], tuple[float, float, float]]
    """The smallest and the largest: length, width, height."""
    BLANK, DOORS_FROM = 0.25, 0.85
    """Shares of the bays: below the first nothing hangs, above the second a door."""
    TO_WALL_M = 1.9
    """From the walls to the way round."""

    def __init__(self, rng: Rng, texels_per_m: float) -> None:
        super().__init__(rng, texels_per_m)
        length, width, _ = self.size
        self.ring = (length / 2 - self.TO_WALL_M, width / 2 - self.TO_WALL_M)

    def _size(self) -> tuple[float, float, float]:
        length, width, height = self.rng.uniform(*self.SIZES_M).tolist()
        return length, width, height

    def _hang(self, panel: Callable[..., Surface], wide: float, draw: float) -> None:
        """Nothing, an equal door, or prints, half of which are of one of a few plates."""
        height = self.size[2]
        if draw < self.BLANK:
            return
        if draw > self.DOORS_FROM and wide > 1.5:
            self._survey(panel(0.3, 0, 0.95, 2.1, "door", text="EXIT", off=0.03, print=_PLATES,
                               detail=1.3))  # fmt: skip
            return
        for k in range(int(self.rng.integers(1, 3))):
            plate = int(self.rng.integers(2 * _PLATES))
            more: dict[str, Any] = {"off": 0.02 + 0.01 * k, "detail": 1.5, "text": self._word()}
            w, h = float(self.rng.uniform(0.4, 0.6 * wide)), float(self.rng.uniform(0.4, 1.4))
            if plate < _PLATES:  # equal in size and print to the others of its plate
                w, h = 0.5 + 0.1 * plate, 0.7 + 0.1 * plate
                more |= {"text": f"PLATE {plate}", "print": 1_000_000 + plate}
            left = float(self.rng.uniform(0.05, max(0.06, wide - w - 0.05)))
            low = float(self.rng.uniform(0.5, max(0.6, min(2.5, height - h - 0.3))))
            material = "screen" if self.rng.random() < 0.1 else "poster"
            self._survey(panel(left, low, w, h, material, **more))

    def _survey(self, surface: Surface) -> None:
        for corner, end in ((0, "a"), (2, "b")):
            self.survey(f"{surface.material}-{len(self.known)}-{end}", surface, corner)

    def things(self) -> None:
        """Furniture along the walls and in the middle; the way round stays free."""
        length, width, _ = self.size
        a, b = (half - _FREE_M for half in self.ring)
        for _ in range(int(self.rng.integers(10, 25))):
            w, d = self.rng.uniform(0.4, 1.6), self.rng.uniform(0.3, 0.6)
            if self.rng.random() < 0.5:
                angle, r = self.rng.uniform(0, 2 * np.pi), np.sqrt(self.rng.random())
                x, y = length / 2 + a * r * np.cos(angle), width / 2 + b * r * np.sin(angle)
            else:
                along, far = self.rng.random(), self.rng.random() < 0.5
                x, y = 0.9 + along * (length - 1.8), 0.4 + far * (width - 0.8)
                if self.rng.random() < 0.5:
                    w, d = d, w
                    x, y = 0.4 + far * (length - 0.8), 0.9 + along * (width - 1.8)
            x, y = np.clip(x, w / 2 + 0.05, length - w / 2), np.clip(y, d / 2 + 0.05, width - d / 2)
            self._stand(float(x), float(y), float(w), float(d), (0.4, 1.5))

    def _stand(self, x: float, y: float, w: float, d: float, high_m: tuple[float, float]) -> None:
        """A piece of furniture about a place, of a random height."""
        top = float(self.rng.uniform(*high_m))
        material = str(self.rng.choice(self.SOLIDS))
        self.stand((x - w / 2, y - d / 2, 0.0), (x + w / 2, y + d / 2, top), material,
                   faces=OPEN, rgb=self._rgb())  # fmt: skip


class _Office(_Interior):
    SIZES_M = (10, 8, 2.8), (14, 10, 3.4)


class _Hall(_Interior):
    SIZES_M = (14, 11, 4.5), (22, 16, 8)

    def things(self) -> None:
        super().things()
        length, width, height = self.size
        for side in (-0.4, 0.4):
            x = length / 2 + side * (self.ring[0] - _FREE_M)
            self.prism((x, width / 2), 0.25, (0, height), 8, "tiles", rgb=self._rgb())


class _Passage(_Interior):
    """A corridor between rooms: two bays of five are blank, more than one in five has a door."""

    SIZES_M = (20, 2.6, 2.8), (32, 3.4, 3.2)
    BLANK, DOORS_FROM, GLAZED = 0.4, 0.75, 0.2
    TO_WALL_M = 0.9

    def things(self) -> None:
        """Cupboards and benches, flat against the walls."""
        length, width, _ = self.size
        for _ in range(int(self.rng.integers(3, 9))):
            w, d = float(self.rng.uniform(0.5, 1.6)), float(self.rng.uniform(0.15, 0.3))
            x = float(self.rng.uniform(1.0, length - 1.0))
            y = 0.02 + d / 2 if self.rng.random() < 0.5 else width - 0.02 - d / 2
            self._stand(x, y, w, d, (0.4, 1.9))


class _Stairwell(_Interior):
    """A well with stairs up two of its walls, galleries where they end, and equal steps."""

    SIZES_M = (9, 7, 6.5), (12, 9, 9)

    def things(self) -> None:
        """Stairs along the south wall to half the height and on along the north one; railings."""
        length, width, height = self.size
        self._of = str(self.rng.choice(("tiles", "laminate", "carpet"))), self._rgb()
        half = 0.45 * height
        deep = width - 2 * _STAIR_M
        self._flight(0.0, 1, 0.0, half)
        self._gallery((length - _STAIR_M, 0.0), (length, width), half, deep)
        self._flight(width - _STAIR_M, -1, half, 0.9 * height)
        self._gallery((0.0, 0.0), (_STAIR_M, width), 0.9 * height, deep)
        for _ in range(int(self.rng.integers(2, 6))):
            x, y = self.rng.uniform(-0.3, 0.3, 2).tolist()
            self._stand(length / 2 + x, width / 2 + y, 0.5, 0.4, (0.4, 1.1))

    def _flight(self, y: float, way: int, low: float, high: float) -> None:
        """Steps that rise along x, or against it, between the galleries at its ends."""
        length = self.size[0]
        count = max(3, round((high - low) / _RISE_M))
        run = (length - 2 * _STAIR_M) / count
        material, rgb = self._of
        front = "-x" if way > 0 else "+x"
        side = "+y" if y == 0 else "-y"
        for k in range(count):
            x = _STAIR_M + k * run if way > 0 else length - _STAIR_M - (k + 1) * run
            top = low + (k + 1) * (high - low) / count
            # The same plate for all steps, as one maker delivers them.
            self.box([x, y, max(top - 0.3, 0.0)], [x + run, y + _STAIR_M, top], material,
                     faces=("+z", front, side, "-z"), rgb=rgb, print=2 * _PLATES)  # fmt: skip
        self.footprints.append(Footprint((_STAIR_M, y, length - _STAIR_M, y + _STAIR_M), "stairs"))

    def _gallery(
        self, low: tuple[float, float], high: tuple[float, float], top: float, deep: float
    ) -> None:
        """A slab across the well's end, and the railing on its inner edge."""
        material, rgb = self._of
        self.box([*low, top - 0.2], [*high, top], material, faces=("-x", "+x", "-z", "+z"), rgb=rgb)
        inner = low[0] if low[0] > 0 else high[0] - 0.05
        y = self.size[1] / 2 - deep / 2
        for k in range(_POSTS):
            at = y + (k + 0.5) * deep / _POSTS
            self.box([inner, at - 0.02, top], [inner + 0.05, at + 0.02, top + 1.0], "metal",
                     rgb=rgb, print=3 * _PLATES)  # fmt: skip
        self.box([inner, y, top + 1.0], [inner + 0.05, y + deep, top + 1.06], "wood", rgb=rgb)
        self.footprints.append(Footprint((*low, *high), "balcony"))


_FREE_M = 0.9
"""Half the width of a way round."""
_PLATES = 4
_STAIR_M, _RISE_M, _POSTS = 1.2, 0.17, 8
"""How wide stairs and galleries are, a step's rise, and a railing's posts."""
KINDS = {"interior": 90_001, "passage": 90_002, "stairwell": 90_003}
"""What is built by number, 1 to 999, with the seeds; odd interiors are halls, even offices."""


def build_interior(kind: str, number: int, texels_per_m: float) -> Scene:
    """The scene `KIND-NUMBER`, from 1 to 999; raises `SimulatorError` for another number."""
    if not 1 <= number <= 999:
        raise SimulatorError(f"{kind} {number}; there are {kind}-1 to {kind}-999")
    hall = _Hall if number % 2 else _Office
    made = {"interior": hall, "passage": _Passage, "stairwell": _Stairwell}[kind]
    room = made(np.random.default_rng([KINDS[kind], number]), texels_per_m)
    return _built(room, f"{kind}-{number}", ring_m=room.ring)


def build_room(seed: int, number: int, texels_per_m: float = 80.0) -> Scene:
    """Room `number` of a seed; the same each time."""
    rng = np.random.default_rng([seed, 2, number])
    return _built(_Room(rng, texels_per_m), f"room-{number}")


def _built(room: _Room, name: str, **more: Any) -> Scene:
    for part in (room.floor_and_ceiling, room.sides, room.things, room.outside):
        part()
    length, width, height = room.size
    room.lamps = [
        (x + w / 2, y + h / 2, height - 0.4)
        for x, w in _pieces(length, 3.5)
        for y, h in _pieces(width, 3.5)
    ]
    return room.scene(name, room.size, int(room.rng.integers(2**31)), **more)
