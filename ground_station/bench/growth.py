"""What a frame costs in maps of other sizes, and the memory that a localizer of a large one takes.

The buildings are made up: landmarks everywhere, described by bytes that are as unlike as RootSIFT's
of different things. Features are made, too, so that the steps after them are measured.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ground_station.arrays import F64, U8
from ground_station.errors import GroundStationError
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.localizer import Localizer
from ground_station.localization.settings import LocalizerSettings, load_preset
from ground_station.localization.visibility import LandmarkIndex, project
from ground_station.map import store
from ground_station.map.descriptors import Descriptors
from ground_station.map.store import Keyframes, Landmarks, Map, MapInfo

_FEATURES, _DIMENSION = 1000, 128
_SIZE_M = 50.0
"""Side of the square that holds the smallest building; 3 m high."""
_DENSER = 10
"""Times as many landmarks in view, in the last row of the table."""
_KEYFRAME, _SHARED = 500, 5
"""Landmarks that a made-up keyframe sees, and keyframes that see a landmark."""
_BYTES = np.round(255 * (np.arange(256) / 255) ** 3).astype(np.uint8)
"""Of even bytes, this makes descriptors whose distance is 1.06 by chance."""


class BenchError(GroundStationError):
    """A measurement that could not be made."""


class MadeUp:
    """The extractor's name in a made-up map; takes no pictures."""

    name, sha256, dimension = "made-up", "0" * 64, _DIMENSION
    distance_scale = 1.0

    def extract(self, image: U8) -> Features:
        """Never asked: the features are made. Raises `BenchError` if it is."""
        raise BenchError("a made-up map has no pictures")


@dataclass(frozen=True)
class _View:
    """A pose (4, 4), another near it to start from, and what is seen."""

    guess: F64
    features: Features


def growth(seed: int, repetitions: int, sizes: tuple[int, int]) -> list[dict[str, Any]]:
    """A frame's steps after its features in a small building and in ones that contain it.

    The second goes on around the small one with the same density, so that what is in view stays the
    same; the third has as many landmarks as the second on a tenth of the area. Each frame is
    projected, associated and solved by a localizer with the default settings. `project_all_ms` is
    what projecting every landmark costs, `project_indexed_ms` those that the index gives.
    """
    rng = np.random.default_rng(seed)
    settings = _settings(relocalize=False)
    small, large = sizes
    rows = []
    buildings = {
        (small, 1): building(rng, small, small),
        (large, 1): building(rng, small, large),
        (large, _DENSER): building(rng, min(_DENSER * small, large), large),
    }
    for (count, density), landmarks in buildings.items():
        map_ = Map(_info(), landmarks, _no_keyframes())
        localizer = Localizer(map_, THESIS_CAMERA, MadeUp(), settings)
        views = [_view(rng, landmarks, settings) for _ in range(repetitions + 1)]
        rows.append((count, density, landmarks, localizer, views))
    # Turn by turn, so that a busy moment of the machine slows all; a first turn warms up.
    estimates = [
        [_locate(localizer, views[turn]) for *_, localizer, views in rows]
        for turn in range(repetitions + 1)
    ][1:]
    table = []
    for k, (count, density, landmarks, _, views) in enumerate(rows):
        mine = [turn[k] for turn in estimates]
        stages = {
            f"{stage}_ms": float(np.median([e.stage_ms.get(stage, 0.0) for e in mine]))
            for stage in ("projection", "association", "pose", "total")
        }
        table.append(
            {
                "landmarks": count,
                "density": density,
                "in_view": float(np.median([e.counts.projected for e in mine])),
                "localized": sum(e.localized for e in mine),
                **stages,
                **_looking_at_all(landmarks, views[1:], settings),
            }
        )
    return table


def _locate(localizer: Localizer, view: _View) -> Any:
    localizer.reset()
    localizer.set_initial_pose(view.guess, 0)
    return localizer.process_features(33_000_000, view.features)


def _looking_at_all(
    landmarks: Landmarks, views: list[_View], settings: LocalizerSettings
) -> dict[str, float]:
    """The projection of every landmark, and of those that the index gives, by themselves."""
    camera, index = THESIS_CAMERA, LandmarkIndex(landmarks)
    spans = np.empty((len(views), 2))
    for span, view in zip(spans, views, strict=True):
        for k in range(2):
            begin = time.perf_counter()
            among = index.near(view.guess, camera, settings.projection) if k else None
            project(landmarks, view.guess, camera, settings.projection, among)
            span[k] = 1e3 * (time.perf_counter() - begin)
    every, indexed = np.median(spans, axis=0)
    return {"project_all_ms": float(every), "project_indexed_ms": float(indexed)}


def _settings(*, relocalize: bool) -> LocalizerSettings:
    settings = load_preset("default")
    recovery = dataclasses.replace(settings.recovery, relocalize=relocalize)
    return dataclasses.replace(settings, recovery=recovery)


def _view(rng: np.random.Generator, landmarks: Landmarks, settings: LocalizerSettings) -> _View:
    """1,000 features near the middle of a building: landmarks as far as there are, and others."""
    angle = rng.uniform(0, 2 * np.pi)
    z = np.array([np.cos(angle), np.sin(angle), 0.0])
    R = np.stack([np.cross(z, [0, 0, 1.0]), [0, 0, -1.0], z], axis=1)
    wTc = poses.pose(R, [*rng.uniform(-1, 1, 2), 1.5])
    camera = THESIS_CAMERA
    seen = project(landmarks, wTc, camera, settings.projection)
    mine = rng.permutation(seen.landmark)[: _FEATURES // 2]
    points = poses.transform(poses.inverse(wTc), landmarks.position_m[mine])
    pixel = rng.uniform(0, [camera.width_px - 1, camera.height_px - 1], (_FEATURES, 2))
    pixel[: len(mine)] = camera.project(points) + rng.normal(0, 1, (len(mine), 2))
    described = Descriptors(_described(rng, _FEATURES))[:]
    described[: len(mine)] = landmarks.descriptor[mine]
    described += rng.normal(0, 0.03, described.shape).astype(np.float32)
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    features = Features(
        pixel.astype(np.float32), np.ones(_FEATURES, np.float32), described.astype(np.float32)
    )
    return _View(wTc @ poses.exp(rng.normal(0, [0.005] * 3 + [0.02] * 3)), features)


def building(rng: np.random.Generator, inner: int, total: int) -> Landmarks:
    """`inner` landmarks on the square around the origin, the others around it as densely."""
    side_m = _SIZE_M * np.sqrt(total / inner)
    around = rng.uniform(-side_m / 2, side_m / 2, (2 * total, 2))
    around = around[np.abs(around).max(axis=1) > _SIZE_M / 2]
    around = around[: total - inner]
    square = rng.uniform(-_SIZE_M / 2, _SIZE_M / 2, (inner, 2))
    angle = rng.uniform(0, 2 * np.pi, total)
    return Landmarks(
        id=np.arange(total),
        position_m=np.c_[np.concatenate([square, around]), rng.uniform(0, 3, total)],
        covariance_m2=np.tile(np.eye(3, dtype=np.float32) * np.float32(1e-5), (total, 1, 1)),
        descriptor=Descriptors(_described(rng, total)),
        spread=np.full(total, 0.2, np.float32),
        view_direction=np.c_[np.cos(angle), np.sin(angle), np.zeros(total)].astype(np.float32),
        view_cos=np.full(total, 0.5, np.float32),
        distance_m=np.tile(np.array([1.0, 8.0], np.float32), (total, 1)),
        observations=np.full(total, _SHARED, np.int32),
    )


def _described(rng: np.random.Generator, count: int) -> U8:
    """Descriptors (count, 128) as a map's file holds them."""
    return np.asarray(_BYTES[rng.integers(0, 256, (count, _DIMENSION), np.uint8)])


def _info() -> MapInfo:
    return MapInfo(MadeUp.name, MadeUp.sha256, _DIMENSION, THESIS_CAMERA, "made-up", "world", "m")


def _no_keyframes() -> Keyframes:
    return Keyframes(
        [], np.empty(0, np.int64), np.empty((0, 4, 4)), np.zeros(1, np.int64),
        np.empty(0, np.int32), np.empty((0, 2), np.float32),
    )  # fmt: skip


def _keyframes(landmarks: Landmarks) -> Keyframes:
    """Keyframes that each see 500 landmarks of a stretch, and each landmark in five of them."""
    order = np.lexsort(np.floor(landmarks.position_m.T[:2] / 5.0))
    count = max(len(landmarks) * _SHARED // _KEYFRAME, 1)
    each = min(_KEYFRAME, len(landmarks))
    first = np.arange(count) * (_KEYFRAME // _SHARED)
    seen = order[(first[:, None] + np.arange(each)) % len(landmarks)]
    wTc = np.tile(np.eye(4), (count, 1, 1))
    wTc[:, :3, 3] = landmarks.position_m[seen[:, 0]]
    return Keyframes(
        names=[f"{k}.png" for k in range(count)],
        time_ns=np.arange(count),
        wTc=wTc,
        offset=np.arange(count + 1, dtype=np.int64) * each,
        landmark=seen.ravel().astype(np.int32),
        pixel_px=np.zeros((seen.size, 2), np.float32),
    )


def memory(seed: int, count: int) -> dict[str, Any]:
    """What a localizer of a map with `count` landmarks takes, in a process of its own.

    The map is written to a temporary folder, loaded, a frame is tracked in it and another looked
    for in all of it. `peak_mb` is the most that was resident (with the pages of the mapped file),
    10⁶ bytes; NaN where the system does not tell. Raises `BenchError` when that process fails, as
    where there is too little memory.
    """
    rng = np.random.default_rng(seed)
    landmarks = building(rng, min(10_000, count), count)
    view = _view(rng, landmarks, _settings(relocalize=True))
    spawned = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="blimp-bench-") as name:
        store.save_tables(Path(name), Map(_info(), landmarks, _keyframes(landmarks)))
        with ProcessPoolExecutor(1, mp_context=spawned) as alone:
            try:
                return {"landmarks": count, **alone.submit(_occupy, Path(name), view).result()}
            except BrokenProcessPool:
                raise BenchError(f"the localizer of {count} landmarks: its process ended") from None


def _occupy(folder: Path, view: _View) -> dict[str, float]:
    """What `memory` measures, in the process that it starts."""
    idle_mb = _peak_mb()
    begin = time.perf_counter()
    localizer = Localizer(store.load(folder), THESIS_CAMERA, MadeUp(), _settings(relocalize=True))
    load_s = time.perf_counter() - begin
    tracked = _locate(localizer, view)
    localizer.reset()
    begin = time.perf_counter()
    localizer.process_features(0, view.features)  # nothing is known: the whole map is searched
    return {
        "load_s": load_s,
        "search_s": time.perf_counter() - begin,
        "tracked": float(tracked.localized),
        "idle_mb": idle_mb,
        "peak_mb": _peak_mb(),
    }


def _peak_mb() -> float:
    """The most memory this process had resident so far, 10⁶ bytes; Linux only, else NaN."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return float("nan")
    kib = next((line.split()[1] for line in lines if line.startswith("VmHWM:")), "nan")
    return float(kib) * 1024 / 1e6
