"""A room of random landmarks, and frames of it without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from synthetic import CAMERA, DIMENSION, NO_KEYFRAMES, FakeExtractor, landmarks_at, unit, unit_rows

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map.store import Map, MapInfo


def looking(position_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """wTc of a camera at a position that looks at a target, its x axis level (z is up)."""
    z = (target_m - position_m) / np.linalg.norm(target_m - position_m)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return poses.pose(np.stack([x, np.cross(z, x), z], axis=1), position_m)


@dataclass
class Room:
    """A box of 8 m by 6 m by 3 m with landmarks on its walls."""

    map: Map
    camera: Camera
    rng: np.random.Generator

    def path(self, count: int, rate_hz: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
        """A slow round near the middle looking outwards: times (N,), ns, and wTc (N, 4, 4)."""
        t = np.arange(count) / rate_hz
        angle = 0.35 * t
        wTc = [
            looking(
                np.array([np.cos(a), 0.8 * np.sin(a), 1.5 + 0.2 * np.sin(2 * a)]),
                np.array([4 * np.cos(a + 0.3), 3 * np.sin(a + 0.3), 1.3]),
            )
            for a in angle
        ]
        return np.round(t * 1e9).astype(np.int64), np.stack(wTc)

    def features(
        self, wTc: np.ndarray, *, noise_px: float = 0.5, outliers: float = 0.2, most: int = 500
    ) -> Features:
        """What a camera at `wTc` sees; a share of the features belongs to nothing."""
        points = poses.transform(poses.inverse(wTc), self.map.landmarks.position_m)
        pixels = self.camera.project(points)
        flat = np.abs(points[:, :2] / points[:, 2:])
        size = [self.camera.width_px - 1, self.camera.height_px - 1]
        seen = (points[:, 2] > 0.1) & (flat < 0.9).all(axis=1)
        seen &= ((pixels >= 0) & (pixels <= size)).all(axis=1)
        index = self.rng.permutation(np.flatnonzero(seen))[:most]
        pixels = pixels[index] + self.rng.normal(0, noise_px, (len(index), 2))
        noise = self.rng.normal(0, 0.03, (len(index), DIMENSION))
        descriptors = unit(self.map.landmarks.descriptor[index] + noise)
        wrong = self.rng.random(len(index)) < outliers
        pixels[wrong] = self.rng.uniform(0, size, (int(wrong.sum()), 2))
        return Features(
            pixels.astype(np.float32),
            np.ones(len(index), np.float32),
            descriptors,
        )


@pytest.fixture
def room() -> Room:
    rng = np.random.default_rng(7)
    count = 4000
    half = np.array([4.0, 3.0, 1.5])
    points = rng.uniform(-1, 1, (count, 3)) * half
    wall = rng.integers(0, 3, count)
    points[np.arange(count), wall] = np.sign(points[np.arange(count), wall]) * half[wall]
    points[:, 2] += 1.5
    towards = np.array([0.0, 0.0, 1.5]) - points
    distance = np.linalg.norm(towards, axis=1)
    landmarks = landmarks_at(
        points,
        unit_rows(rng, count),
        view_direction=(towards / distance[:, None]).astype(np.float32),
        distance_m=np.stack([0.4 * distance, 1.6 * distance], axis=1).astype(np.float32),
    )
    fake = FakeExtractor
    info = MapInfo(fake.name, fake.sha256, DIMENSION, CAMERA, "room", "world", "m")
    return Room(Map(info, landmarks, NO_KEYFRAMES), CAMERA, rng)


@pytest.fixture
def extractor() -> FakeExtractor:
    return FakeExtractor()
