"""Random rooms, drawn in several lights from one place.

None is the `atrium` or the `office`: localizers are judged there, so the network never sees them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from ground_station.arrays import F64, U8
from ground_station.geometry.camera import Camera
from ground_station.simulator.imaging import AutoExposure, FrameMaker
from ground_station.simulator.interiors import build_room
from ground_station.simulator.lighting import LIGHTS, Light, LitTextures, lit_textures, looking
from ground_station.simulator.rendering import Pinhole, SceneRenderer
from ground_station.simulator.scene import Scene

Rng = np.random.Generator

_OVER = 1.5
_NEAR_M = 0.7
_LEAST_DEVIATION = 12.0
"""Of a picture's codes: a blank wall close by teaches nothing."""
_TRIES = 30
_LAMPS_OFF = 0.35
"""Share of the lights in which no lamp is on."""


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
