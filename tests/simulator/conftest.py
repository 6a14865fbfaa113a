"""A plain room of dots for geometry, and short flights at low resolution for everything else."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from quick_flight import quick_light, quick_settings

from ground_station.arrays import F32, F64, U8
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.simulator import lighting
from ground_station.simulator import simulate as flights
from ground_station.simulator.building import SceneBuilder
from ground_station.simulator.imaging import FrameMaker, covering_pinhole
from ground_station.simulator.rendering import SceneRenderer
from ground_station.simulator.scene import Surface
from ground_station.simulator.simulate import simulate
from ground_station.simulator.textures import TextureBank

TEXELS_PER_M = 100
DOT_M = 0.10


@dataclass(frozen=True)
class Room:
    """Dark surfaces with bright square dots: their centres and half-edges in world metres."""

    renderer: SceneRenderer
    centres: F64
    half_edges: F64  # (N, 2, 3)
    decoder: F32
    supersampling: float

    def maker(self, camera: Camera, renders: int) -> FrameMaker:
        pinhole = covering_pinhole(camera, self.supersampling)
        return FrameMaker(self.renderer, self.decoder, camera, pinhole, renders=renders)


def _dotted(surface: Surface, rng: np.random.Generator) -> tuple[U8, F64, F64]:
    columns, rows = surface.size_texels
    texture = np.full((rows, columns, 3), 40, np.uint8)
    n = round(DOT_M * TEXELS_PER_M)
    centres, halves = [], []
    u, v = (e / np.linalg.norm(e) for e in (surface.u_m, surface.v_m))
    for row in range(20, rows - 30, 45):
        for column in range(20, columns - 30, 45):
            r, c = row + int(rng.integers(10)), column + int(rng.integers(10))
            texture[r : r + n, c : c + n] = 255
            s = (c + n / 2) / TEXELS_PER_M
            t = (rows - r - n / 2) / TEXELS_PER_M
            centres.append(surface.origin_m + s * u + t * v)
            halves.append([0.5 * DOT_M * u, 0.5 * DOT_M * v])
    return texture, np.array(centres), np.array(halves)


_kept_lit_scene = functools.cache(lighting.lit_scene.__wrapped__)


@contextmanager
def coarse_light() -> Iterator[None]:
    """Quick light, and each lit scene is kept."""
    with quick_light() as patch:
        patch.setattr(flights, "lit_scene", _kept_lit_scene)
        yield


@pytest.fixture(scope="module", autouse=True)
def _coarse_light() -> Iterator[None]:
    with coarse_light():
        yield


@pytest.fixture(scope="session")
def bank() -> TextureBank:
    """The fields that every scene's textures are cut from; they take seconds to make."""
    with coarse_light():
        return TextureBank(7)


@pytest.fixture(scope="session")
def room() -> Iterator[Room]:
    with open_room(THESIS_CAMERA) as opened:
        yield opened


@contextmanager
def open_room(camera: Camera) -> Iterator[Room]:
    """The room, drawn large enough for a camera."""
    builder = SceneBuilder(TEXELS_PER_M)
    builder.rectangle([5, 2.5, 0], [0, -5.5, 0], [0, 0, 4], "dots")  # ahead
    builder.rectangle([0, 2.5, 0], [5, 0, 0], [0, 0, 4], "dots")  # left
    builder.rectangle([0, -3, 0], [5, 0, 0], [0, 5.5, 0], "dots")  # floor
    rng = np.random.default_rng(4)
    textures, centres, halves = zip(*(_dotted(s, rng) for s in builder.surfaces), strict=True)
    decoder = (np.arange(256) / 255.0).astype(np.float32)
    supersampling = 1.25
    pinhole = covering_pinhole(camera, supersampling)
    size = (pinhole.width_px, pinhole.height_px)
    with SceneRenderer(builder.surfaces, textures, size) as renderer:
        yield Room(
            renderer, np.concatenate(centres), np.concatenate(halves), decoder, supersampling
        )


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short recording."""
    out = tmp_path_factory.mktemp("simulator") / "flight.mcap"
    with coarse_light():
        simulate(quick_settings(out))
    return out
