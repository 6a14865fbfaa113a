"""A room of known points, seen by a camera with a strong lens, and the map built of it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hand_made import in_picture

from ground_station.arrays import F64, I64, U8
from ground_station.features import extractors
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.map import store
from ground_station.mapping.construction import build
from ground_station.mapping.settings import MappingSettings
from ground_station.recording.frames import Frame

DIMENSION = 32
NOISE_PX = 0.3
STEP_NS = 100_000_000


@dataclass
class Scene:
    """Points (N, 3), metres, poses (K, 4, 4), and the features of each image."""

    camera: Camera
    points: F64
    wTc: F64
    seen: list[I64]
    features: list[Features]

    def frames(self) -> Iterator[Frame]:
        """Frames whose first pixel is the number of the image, for `SceneExtractor`."""
        for k in range(len(self.wTc)):
            image = np.zeros((self.camera.height_px, self.camera.width_px), np.uint8)
            image[0, 0] = k
            yield Frame(k, f"frame-{k:06d}", k * STEP_NS, image)


class SceneExtractor:
    """Gives a scene's features in place of an image's."""

    name = "scene"
    sha256 = "0" * 64
    dimension = DIMENSION
    distance_scale = 1.0

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def extract(self, image: U8) -> Features:
        return self._scene.features[int(image[0, 0])]


def look_at(position: npt.ArrayLike, target: npt.ArrayLike) -> F64:
    """wTc of a camera at `position` that looks at `target`, z up in the world."""
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return poses.pose(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def make_scene(images: int = 16, points: int = 700, seed: int = 3) -> Scene:
    """Points on the walls of a room of 8 x 6 x 3 m and a camera that walks through it."""
    rng = np.random.default_rng(seed)
    size = np.array([8.0, 6.0, 3.0])
    xyz = rng.uniform(0, 1, (points, 3)) * size
    wall = rng.integers(0, 3, points)
    xyz[np.arange(points), wall] = np.where(rng.random(points) < 0.5, 0.0, size[wall])
    descriptor = np.abs(rng.normal(size=(points, DIMENSION)))
    wTc = np.array(
        [
            look_at([1.0 + 0.25 * k, 1.2 + 0.08 * k, 1.5 + 0.3 * np.sin(k)], [7.5, 5.5, 1.2])
            for k in range(images)
        ]
    )
    camera = THESIS_CAMERA
    seen, features = [], []
    for T in wTc:
        local = poses.transform(poses.inverse(T), xyz)
        pixel = camera.project(local)
        index = np.flatnonzero(in_picture(camera, local, pixel, 0.8))
        vectors = descriptor[index] + 0.05 * np.abs(rng.normal(size=(len(index), DIMENSION)))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        noisy = pixel[index] + NOISE_PX * rng.normal(size=(len(index), 2))
        seen.append(index)
        features.append(
            Features(
                noisy.astype(np.float32),
                np.ones(len(index), np.float32),
                vectors.astype(np.float32),
            )
        )
    return Scene(camera, xyz, wTc, seen, features)


@dataclass
class Built:
    """A scene and the map that was built of it."""

    scene: Scene
    settings: MappingSettings
    map: store.Map
    folder: Path


@pytest.fixture(scope="session")
def scene_settings() -> MappingSettings:
    return MappingSettings(features="scene", threads=2)


@pytest.fixture
def use_scene(monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Registers an extractor that gives the features of a scene."""

    def use(scene: Scene) -> None:
        monkeypatch.setitem(extractors.METHODS, "scene", lambda _: SceneExtractor(scene))

    return use


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory, scene_settings: MappingSettings) -> Built:
    """Built once; tests that change it work on a copy."""
    scene = make_scene()
    folder = tmp_path_factory.mktemp("built") / "room"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(extractors.METHODS, "scene", lambda _: SceneExtractor(scene))
        map_ = build.build_map(scene.frames(), scene.camera, scene_settings, folder)
    return Built(scene, scene_settings, map_, folder)


@pytest.fixture
def target(built: Built, tmp_path: Path) -> Path:
    """A copy of the built map."""
    return Path(shutil.copytree(built.folder, tmp_path / "map"))
