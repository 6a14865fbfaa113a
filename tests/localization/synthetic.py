"""Maps, settings and descriptors made by hand, of which a test says what it is about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.map.store import Keyframes, Landmarks

DIMENSION = 64
CAMERA = replace(THESIS_CAMERA, readout_s=0.0)
"""All rows at once, as the synthetic frames have them."""


class FakeExtractor:
    """Names the synthetic features; takes no pictures."""

    name, sha256, dimension = "synthetic", "0" * 64, DIMENSION
    distance_scale = 1.0

    def extract(self, image: np.ndarray) -> Features:
        raise AssertionError("synthetic frames have no pictures")


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows (N, D) at unit length, as descriptors are."""
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def unit_rows(rng: np.random.Generator, count: int, dimension: int = DIMENSION) -> np.ndarray:
    return unit(rng.normal(size=(count, dimension)))


def landmarks_at(position_m: np.ndarray, descriptor: np.ndarray, **others: Any) -> Landmarks:
    """Landmarks at positions (N, 3), known to a centimetre and seen from 3 to 6 m behind the plane
    z = 0, unless something else is said."""
    n = len(position_m)
    usual = {
        "id": np.arange(n, dtype=np.int64),
        "covariance_m2": np.tile(np.eye(3, dtype=np.float32) * 1e-4, (n, 1, 1)),
        "spread": np.full(n, 0.1, np.float32),
        "view_direction": np.tile(np.array([0, 0, -1], np.float32), (n, 1)),
        "view_cos": np.full(n, 0.5, np.float32),
        "distance_m": np.tile(np.array([3, 6], np.float32), (n, 1)),
        "observations": np.full(n, 5, np.int32),
    }
    return Landmarks(position_m=position_m, descriptor=descriptor, **(usual | others))


def keyframes_of(wTc: np.ndarray, seen: Sequence[np.ndarray]) -> Keyframes:
    """Keyframes at poses (K, 4, 4), and the landmarks that each saw, somewhere."""
    offset = np.cumsum([0, *map(len, seen)], dtype=np.int64)
    return Keyframes(
        names=[str(k) for k in range(len(seen))],
        time_ns=np.arange(len(seen), dtype=np.int64),
        wTc=wTc,
        offset=offset,
        landmark=np.concatenate([*seen, np.empty(0)]).astype(np.int32),
        pixel_px=np.zeros((offset[-1], 2), np.float32),
    )


NO_KEYFRAMES = keyframes_of(np.empty((0, 4, 4)), [])


def preset_with(preset: str = "default", **tables: dict[str, Any]) -> LocalizerSettings:
    """A preset with other values: `preset_with("thesis", pose={"sigma_px": 2.0})`."""
    settings = load_preset(preset)
    return replace(
        settings,
        **{name: replace(getattr(settings, name), **values) for name, values in tables.items()},
    )


def apart(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """How far a pose (4, 4) is off: metres and radians."""
    step = poses.log(poses.inverse(truth) @ found)
    return float(np.linalg.norm(step[3:])), float(np.linalg.norm(step[:3]))


def all_compared(
    distance: np.ndarray, near: np.ndarray, limit: float, ratio: float
) -> list[tuple[int, int]]:
    """The pairs of features and landmarks by comparing every one with every other (F, L)."""
    best: dict[int, tuple[float, int]] = {}
    for i, row in enumerate(np.where(near, distance, np.inf)):
        j = int(np.argmin(row))
        stands_out = row[j] < limit and row[j] <= ratio * np.delete(row, j).min(initial=np.inf)
        if stands_out and (j not in best or row[j] < best[j][0]):
            best[j] = row[j], i
    return sorted((i, j) for j, (_, i) in best.items())
