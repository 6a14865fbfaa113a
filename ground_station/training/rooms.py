"""Rooms by chance, built of the simulator's surfaces and drawn in several lights from one place.

None is the `atrium` or the `office`: localizers are judged there, so the network never sees them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from ground_station.arrays import F64, U8
from ground_station.geometry.camera import Camera
from ground_station.simulator.building import OPEN, SceneBuilder
from ground_station.simulator.imaging import AutoExposure, FrameMaker
from ground_station.simulator.lighting import LIGHTS, Light, LitTextures, lit_textures, looking
from ground_station.simulator.rendering import Pinhole, SceneRenderer
from ground_station.simulator.scene import Lamp, Scene

Rng = np.random.Generator

_WALL = ("plaster", "plaster", "brick", "concrete", "wood")
_SOLID = ("wood", "metal", "fabric", "concrete", "plaster", "foliage")
_OVER = 1.5
_NEAR_M = 0.7
_LEAST_DEVIATION = 12.0
"""Of a picture's codes: a blank wall close by teaches nothing."""
_TRIES = 30
_LAMPS_OFF = 0.35
"""Share of the lights in which no lamp is on."""


class _Room:
    """A box of random size, cut into bays; every wall, window and thing in it by chance."""

    def __init__(self, rng: Rng, texels_per_m: float) -> None:
        self.rng, self.b = rng, SceneBuilder(texels_per_m)
        self.size = (float(rng.uniform(6, 17)), float(rng.uniform(5, 12)), float(rng.uniform(3, 7)))
        self.bay = float(rng.uniform(1.6, 3.6))
        self.colours = [self._colour() for _ in range(5)]
        self.material = str(rng.choice(_WALL))

    def _colour(self) -> tuple[float, ...]:
        grey = np.exp(self.rng.uniform(np.log(0.08), np.log(0.75)))
        return tuple(np.clip(grey * (1 + 0.3 * self.rng.standard_normal(3)), 0.04, 0.85).tolist())

    def _rgb(self) -> tuple[float, ...]:
        return self.colours[int(self.rng.integers(len(self.colours)))]

    def floor_and_ceiling(self) -> None:
        """Slabs or planks below, panels above, some of them open to the sky."""
        length, width, height = self.size
        floor = str(self.rng.choice(["terrazzo", "wood", "concrete"]))
        step, rgb = float(self.rng.uniform(2.5, 5)), self._rgb()
        options: dict[str, Any] = {"slab_m": float(self.rng.uniform(0.3, 1.2))}
        for x, w in _pieces(length, step):
            for y, h in _pieces(width, step):
                self.b.rectangle([x, y, 0], [w, 0, 0], [0, h, 0], floor, rgb=rgb, **options)
                if self.rng.random() < 0.12:  # a rooflight
                    continue
                self.b.rectangle([x, y + h, height], [w, 0, 0], [0, -h, 0], "concrete",
                                 rgb=self._rgb(), tie_m=0.8, detail=0.6)  # fmt: skip
            if self.rng.random() < 0.6:
                self.b.box([x - 0.1, 0, height - 0.3], [x + 0.1, width, height], "wood",
                           faces=("-x", "+x", "-z"), detail=0.6)  # fmt: skip

    def walls(self) -> None:
        """Four walls in bays: blank, with a window, a door or signs."""
        length, width, _ = self.size
        corners = ((0, 0, length), (length, 0, width), (length, width, length), (0, width, width))
        ways = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        for (x, y, run), (ux, uy) in zip(corners, ways, strict=True):
            glazed = self.rng.random() < 0.5
            for start, wide in _pieces(run, self.bay):
                # Fronts look into the room: u runs the other way round.
                origin = np.array([x + ux * (start + wide), y + uy * (start + wide), 0.0])
                self._bay(origin, np.array([-ux, -uy, 0.0]), wide, glazed)

    def _bay(self, origin: F64, u: F64, wide: float, glazed: bool) -> None:
        height = self.size[2]
        rgb, up = self._rgb(), np.array([0.0, 0.0, 1.0])
        inward = np.cross(u, up)

        def panel(left: float, low: float, w: float, h: float, material: str, **o: Any) -> None:
            place = origin + u * left + up * low + inward * float(o.pop("off", 0.0))
            self.b.rectangle(place, u * w, up * h, material, **o)

        draw = self.rng.random()
        if glazed and draw < 0.75 and wide > 1.2:
            sill, top = 0.9, min(height - 0.4, float(self.rng.uniform(2.2, 3.4)))
            panel(0, 0, wide, sill, self.material, rgb=rgb)
            panel(0, top, wide, height - top, self.material, rgb=rgb)
            panel(0, sill, 0.3, top - sill, self.material, rgb=rgb)
            panel(wide - 0.3, sill, 0.3, top - sill, self.material, rgb=rgb)
            dark = (0.12, 0.12, 0.13)
            panel(wide / 2 - 0.03, sill, 0.06, top - sill, "metal", rgb=dark)
            panel(0.3, (sill + top) / 2, wide - 0.6, 0.06, "metal", rgb=dark)
            return
        material = self.material if self.rng.random() < 0.7 else str(self.rng.choice(_WALL))
        panel(0, 0, wide, height, material, rgb=rgb)
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
            material = str(self.rng.choice(_SOLID))
            faces = (*OPEN, "-z") if low > 0 else OPEN
            self.b.box([x, y, low], [x + w, y + d, high], material, faces=faces, rgb=self._rgb())
            if w > 0.5 and self.rng.random() < 0.4:
                self.b.rectangle([x + 0.05, y + 0.05, high + 0.003], [w - 0.1, 0, 0],
                                 [0, max(0.1, d - 0.1), 0], "poster",
                                 text=self._word())  # fmt: skip
        for _ in range(int(self.rng.integers(0, 6))):
            centre = (float(self.rng.uniform(1, length - 1)), float(self.rng.uniform(1, width - 1)))
            self.b.prism(centre, float(self.rng.uniform(0.12, 0.4)), (0, height),
                         int(self.rng.integers(4, 12)), "concrete", rgb=self._rgb(),
                         band=(1.1, 1.4, self._rgb()))  # fmt: skip

    def outside(self) -> None:
        """Sky, hedges and ground beyond the windows, on all sides."""
        length, width, height = self.size
        far = 8.0
        self.b.rectangle([-far, -far, -0.02], [length + 2 * far, 0, 0], [0, width + 2 * far, 0],
                         "concrete", detail=0.15, outside=True)  # fmt: skip
        sides = (
            ([length + far, -far, 0], [-length - 2 * far, 0, 0]),
            ([length + far, width + far, 0], [0, -width - 2 * far, 0]),
            ([-far, width + far, 0], [length + 2 * far, 0, 0]),
            ([-far, -far, 0], [0, width + 2 * far, 0]),
        )
        for origin, u in sides:
            self.b.rectangle(origin, u, [0, 0, 14], "sky", detail=0.25, outside=True)
            near = 0.98 * np.asarray(origin) + 0.02 * np.array([length / 2, width / 2, 0])
            self.b.rectangle(near, 0.98 * np.asarray(u), [0, 0, float(self.rng.uniform(2, 5))],
                             "foliage", detail=0.4, zoom=1.2, outside=True)  # fmt: skip
        self.b.rectangle([-far, width + far, height + 6], [length + 2 * far, 0, 0],
                         [0, -width - 2 * far, 0], "sky", detail=0.2, outside=True)  # fmt: skip


def _pieces(length: float, step: float) -> list[tuple[float, float]]:
    """Equal pieces of about `step`: (start, length) of each."""
    count = max(1, round(length / step))
    return [(k * length / count, length / count) for k in range(count)]


def build_room(seed: int, number: int, texels_per_m: float = 80.0) -> Scene:
    """Room `number` of a seed; the same each time."""
    rng = np.random.default_rng([seed, 2, number])
    room = _Room(rng, texels_per_m)
    for part in (room.floor_and_ceiling, room.walls, room.things, room.outside):
        part()
    length, width, height = room.size
    room.b.lamps = [
        Lamp((x + w / 2, y + h / 2, height - 0.4))
        for x, w in _pieces(length, 3.5)
        for y, h in _pieces(width, 3.5)
    ]
    return room.b.scene(f"room-{number}", room.size, int(rng.integers(2**31)))


def _lit(scene: Scene, base: Light, rng: Rng) -> LitTextures:
    """A room in one of the simulator's lights, moved: another hour, another strength of the sky.

    Its lamps are off, or some of them are on: in rooms with few windows they make the shadows.
    """
    on = rng.random(len(scene.lamps)) < rng.uniform(0.2, 1)
    lamps = tuple(lamp for lamp, lights in zip(scene.lamps, on.tolist(), strict=True) if lights)
    light = _moved(base, float(np.exp(rng.uniform(np.log(0.03), np.log(0.8)))), rng)
    if rng.random() < _LAMPS_OFF:
        light = replace(light, lamp_level=0.0)
    return lit_textures(replace(scene, lamps=lamps), light)


def _moved(base: Light, lamp_level: float, rng: Rng) -> Light:
    return replace(
        base,
        sun_azimuth_deg=float(rng.uniform(0, 360)),
        sun_elevation_deg=float(np.clip(base.sun_elevation_deg + rng.normal(0, 10), 4, 75)),
        sun_level=base.sun_level * float(np.exp(rng.normal(0, 0.3))),
        sky_level=base.sky_level * float(np.exp(rng.normal(0, 0.3))),
        lamp_level=lamp_level,
    )


def views_of_room(
    seed: int, number: int, places: int, lights: int, size: tuple[int, int]
) -> Iterator[U8]:
    """For each place in a room its pictures (lights, rows, columns), equal but for the light.

    Raises `SimulatorError` where this machine cannot render.
    """
    rng = np.random.default_rng([seed, 3, number])
    scene = build_room(seed, number)
    poses = [_pose(rng, scene) for _ in range(places * _TRIES)]
    names = rng.permutation(sorted(LIGHTS)).tolist()  # no two the same, if there are enough
    lit = [_lit(scene, LIGHTS[names[k % len(names)]], rng) for k in range(lights)]
    rows, columns = size
    focal = float(rng.uniform(0.65, 1.0)) * columns
    camera = Camera(
        width_px=columns, height_px=rows, fx_px=focal, fy_px=focal,
        cx_px=(columns - 1) / 2, cy_px=(rows - 1) / 2,
    )  # fmt: skip
    chosen: list[F64] = []
    stacks: list[list[U8]] = []
    for k, textures in enumerate(lit):
        # One light at a time: the textures fill the graphics memory.
        pictures = _pictures(scene, textures, camera, poses if k == 0 else chosen, places, k == 0)
        for place, (wTc, picture) in enumerate(pictures):
            if k == 0:
                chosen.append(wTc)
                stacks.append([])
            stacks[place].append(picture)
    for stack in stacks:
        yield np.stack(stack)


def _pose(rng: Rng, scene: Scene) -> F64:
    """Somewhere in the room, looking about level, a little rolled."""
    margin = np.array([0.6, 0.6, 0.5])
    position = rng.uniform(margin, np.asarray(scene.size_m) - margin)
    azimuth, down = rng.uniform(0, 2 * np.pi), rng.normal(0.05, 0.25)
    back = -np.array(
        [np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down)]
    )
    wTc = looking(back, position, 0.0)
    roll = rng.normal(0, 0.08)
    c, s = np.cos(roll), np.sin(roll)
    wTc[:3, :2] = wTc[:3, :2] @ np.array([[c, -s], [s, c]])
    return wTc


def _pictures(
    scene: Scene,
    lit: LitTextures,
    camera: Camera,
    poses: list[F64],
    most: int,
    choosy: bool,
) -> Iterator[tuple[F64, U8]]:
    """Poses and their pictures; `choosy`: only of those that show something, at most `most`."""
    scale = _OVER
    large = Pinhole(
        round(camera.width_px * scale), round(camera.height_px * scale), camera.fx_px * scale
    )
    with SceneRenderer(
        scene.surfaces, lit.textures, (large.width_px, large.height_px), samples=0
    ) as renderer:
        maker = FrameMaker(renderer, lit.decoder(), camera, large)
        taken = 0
        for wTc in poses:
            if taken == most:
                return
            codes, depth = renderer.image_and_depth(wTc, large)
            if choosy and float(np.percentile(depth[::8, ::8], 10)) < _NEAR_M:
                continue
            size = (camera.width_px, camera.height_px)
            small = cv2.resize(cv2.LUT(codes, lit.decoder()), size, interpolation=cv2.INTER_AREA)
            radiance = np.asarray(small, np.float32)
            exposure_s, gain = AutoExposure(maker.sensor, radiance).settings
            # Noise is the degradation's business.
            picture = maker.expose(radiance, exposure_s, gain, None)
            grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
            if choosy and float(grey.std()) < _LEAST_DEVIATION:
                continue
            taken += 1
            yield wTc, np.asarray(grey, np.uint8)
