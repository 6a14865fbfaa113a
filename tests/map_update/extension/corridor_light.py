"""A corridor of known points in two lights, the map of a part of it, and flights as pictures.

A picture's first pixel is its number: the extractor gives what the camera there sees. By noon every
point has its own descriptor. By sunset some keep it, some look otherwise by a known angle, and some
are seen then only.
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hand_made import in_picture, keyframes_of, observed

from ground_station.features import extractors
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.map import colmap, landmarks, store
from ground_station.map_update.extension.extend import Extension, extend_map
from ground_station.mapping.settings import ExtendSettings, MappingSettings

DIMENSION = 64
CAMERA = dataclasses.replace(THESIS_CAMERA, readout_s=0.0)
RATE_HZ = 5.0
"""So far apart the localizer describes every frame itself: there is nothing to follow in them."""
LENGTH_M, MAPPED_M = 15.0, 8.0
TURNED = np.deg2rad(70.0)
"""Between a point's two looks: 1.15 as a distance, which no localizer takes for one point."""
SETTINGS = MappingSettings(features="corridor", threads=1, extend=ExtendSettings(min_track=3))


def unit(rows):
    """Rows of length 1."""
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


@dataclasses.dataclass
class Corridor:
    """Points (N, 3), metres, on a rough wall along x; descriptors by light; pictures by number."""

    points: np.ndarray
    noon: np.ndarray
    sunset: np.ndarray
    turns: np.ndarray
    """Which points look otherwise by sunset."""
    late: np.ndarray
    """Which points are not seen by noon."""
    pictures: list[Features] = dataclasses.field(default_factory=list)
    name, sha256, dimension = "corridor", "c" * 64, DIMENSION
    distance_scale = 1.0

    def extract(self, image):
        """The features of a picture by its number, as an `Extractor`."""
        return self.pictures[int(image[0, 0])]

    def pose(self, x_m, seed=0):
        """wTc of a camera that looks at the wall from 4 m, a little to and fro."""
        z = np.array([0.15 * np.sin(0.7 * x_m + seed), 1.0, 0.05 * np.cos(x_m + seed)])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        way = [x_m, 0.2 * np.sin(x_m + seed), 1.5 + 0.2 * np.sin(0.9 * x_m + seed)]
        return poses.pose(np.stack([x, np.cross(z, x), z], axis=1), way)

    def seen(self, wTc, light, rng, noise_px=0.3):
        """Points, distorted pixels and descriptors of one picture."""
        local = poses.transform(poses.inverse(wTc), self.points)
        pixel = CAMERA.project(local) + noise_px * rng.normal(size=(len(local), 2))
        inside = in_picture(CAMERA, local, pixel, 0.75)
        if light == "noon":
            inside &= ~self.late
        index = np.flatnonzero(inside)
        look = (self.noon if light == "noon" else self.sunset)[index]
        look = unit(look + 0.02 * rng.normal(size=look.shape))
        return index, pixel[index].astype(np.float32), look.astype(np.float32)

    def flight(self, folder: Path, start_m, end_m, light, seed, step_m=0.25) -> np.ndarray:
        """Writes a flight as a folder of pictures; gives its true poses (K, 4, 4)."""
        rng = np.random.default_rng(seed)
        folder.mkdir()
        truth = []
        board = np.kron(np.indices((15, 20)).sum(axis=0) % 2, np.ones((32, 32))) * 200
        for k, x_m in enumerate(np.arange(start_m, end_m, step_m)):
            truth.append(self.pose(x_m, seed))
            _, pixel, look = self.seen(truth[-1], light, rng)
            image = board.astype(np.uint8)
            image[0, 0] = len(self.pictures)
            assert len(self.pictures) < 256
            cv2.imwrite(str(folder / f"{k:03d}.png"), image)
            self.pictures.append(Features(pixel, np.ones(len(pixel), np.float32), look))
        return np.array(truth)


def make_corridor(count=1100, seed=5) -> Corridor:
    """Half of the points look otherwise by sunset, one in six is seen then only."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, 3.2, 0.2], [LENGTH_M + 2, 4.8, 2.9], (count, 3))
    noon, other = unit(rng.normal(size=(2, count, DIMENSION)))
    other = unit(other - noon * np.sum(noon * other, axis=1, keepdims=True))
    turns = rng.random(count) < 0.5
    late = rng.random(count) < 1 / 6
    angle = np.where(turns, TURNED, 0.0)[:, None]
    return Corridor(points, noon, np.cos(angle) * noon + np.sin(angle) * other, turns, late)


def write_map(corridor: Corridor, folder: Path, seed=1) -> store.Map:
    """The noon map of the corridor's first metres, from true poses, registered."""
    rng = np.random.default_rng(seed)
    wTc = np.array([corridor.pose(x, seed) for x in np.arange(0.5, MAPPED_M, 0.3)])
    rows = [corridor.seen(T, "noon", rng) for T in wTc]
    model, used = observed(CAMERA, wTc, corridor.points, rows, least=3)
    pixel, look = (np.concatenate([row[i] for row in rows])[used] for i in (1, 2))
    info = store.MapInfo("corridor", "c" * 64, DIMENSION, CAMERA, folder.name, "world", "m")
    info.registration = {"method": "observations", "points": 12}
    map_ = store.Map(
        info,
        landmarks.make_landmarks(model, look),
        keyframes_of(
            wTc, 10**9,
            offset=np.searchsorted(model.image, np.arange(len(rows) + 1)),
            landmark=model.point.astype(np.int32), pixel_px=pixel,
        ),
    )  # fmt: skip
    folder.mkdir()
    colmap.write(colmap.from_arrays(model, CAMERA), folder / "sparse")
    store.save_tables(folder, map_)
    (folder / "floorplan.yaml").write_text("resolution: 0.05\n")
    return store.load(folder)


@dataclasses.dataclass
class World:
    """The corridor, its map's folder and its flights' folders with true poses, by name."""

    corridor: Corridor
    folder: Path
    flights: dict[str, Path]
    truth: dict[str, np.ndarray]

    def points_of(self, map_: store.Map) -> np.ndarray:
        """The corridor's points (M,) of a map's landmarks: the nearest ones."""
        apart = np.linalg.norm(map_.landmarks.position_m[:, None] - self.corridor.points, axis=2)
        return apart.argmin(axis=1)


def make_world(folder: Path) -> World:
    """A map of the first 8 m by noon, and flights."""
    corridor = make_corridor()
    write_map(corridor, folder / "corridor")
    plans = {
        "sunset": (1.0, 6.5, "sunset", 21),
        "again": (1.1, 6.4, "sunset", 22),
        "noon": (1.2, 6.4, "noon", 23),
        "wing": (3.0, 14.0, "noon", 24),
        "elsewhere": (12.0, 14.0, "noon", 25),
    }
    truth = {name: corridor.flight(folder / name, *plan) for name, plan in plans.items()}
    return World(corridor, folder / "corridor", {n: folder / n for n in plans}, truth)


@pytest.fixture(scope="session")
def _corridor_world(tmp_path_factory) -> World:
    return make_world(tmp_path_factory.mktemp("corridor"))


@pytest.fixture
def corridor_world(_corridor_world, monkeypatch) -> World:
    """Its extractor is registered; tests that change the map work on a copy (`--out`)."""
    monkeypatch.setitem(extractors.METHODS, "corridor", lambda _: _corridor_world.corridor)
    return _corridor_world


def extended(world: World, out: Path, *inputs: Path) -> tuple[store.Map, store.Map, Extension]:
    """The map as it was and as it is with more inputs, in another folder."""
    _, result = extend_map(world.folder, inputs, SETTINGS, out=out, rate_hz=RATE_HZ)
    return store.load(world.folder), store.load(out), result


@pytest.fixture(scope="session")
def by_sunset(_corridor_world, tmp_path_factory):
    """Extended once by the sunset flight; the tests only read it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(extractors.METHODS, "corridor", lambda _: _corridor_world.corridor)
        out = tmp_path_factory.mktemp("sunset") / "extended"
        return extended(_corridor_world, out, _corridor_world.flights["sunset"])


@pytest.fixture
def short_flight(corridor_world, tmp_path):
    """The first frames of the sunset flight: enough to join."""
    folder = tmp_path / "short"
    folder.mkdir()
    for path in sorted(corridor_world.flights["sunset"].iterdir())[:9]:
        shutil.copy(path, folder / path.name)
    return folder
