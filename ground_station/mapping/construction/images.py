"""The frames of a build as features: what is kept of each image."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ground_station.arrays import F64, I64, U8
from ground_station.errors import InputError, MapError
from ground_station.features import extractors
from ground_station.features.extractor import Extractor, Features
from ground_station.geometry.camera import Camera
from ground_station.geometry.resizing import misfit
from ground_station.mapping.construction import content
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.construction.feature_file import FeatureFile
from ground_station.mapping.construction.workers import Workers
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.frames import Frame

_LOCAL = threading.local()


@dataclass(frozen=True)
class Images:
    """What is kept of n frames: names, times (n,), features, their undistorted pixels (N, 2).

    `features` may lie in a file, and are mapped when they are looked at. `keys` are the hashes by
    which a cache knows the features, none without a cache.
    """

    names: list[str]
    time_ns: I64
    features: Sequence[Features]
    pinhole_px: list[F64]
    keys: list[bytes] = field(default_factory=list)


def extract(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    workers: Workers,
    total: int | None,
    *,
    cache: Cache | None = None,
    folder: Path | None = None,
) -> Images:
    """Features of all frames, extracted in parallel while the input is read.

    What `cache` holds is not extracted again. With a `folder` the features lie in a file there,
    for as long as the images are used, else in memory. Raises `InputError` for fewer than two
    frames, `MapError` for a size other than the camera's.
    """
    names: list[str] = []
    times: list[int] = []
    kept = FeatureFile(folder) if folder else None
    in_memory: dict[int, Features] = {}
    pixels: dict[int, F64] = {}
    keys: list[bytes] = []
    under_way: deque[int] = deque()
    how = content.extraction(extractor_of(settings), settings) if cache else b""

    def keep(k: int, features: Features) -> None:
        # What a cache has of a picture knows nothing of the lens: a better one may use more of it.
        features = features.where(camera.uses(features.keypoints_px))
        pixels[k] = camera.undistort_to_pinhole(features.keypoints_px)
        if kept is None:
            in_memory[k] = features
        else:
            kept.put(k, features)
        progress.step()

    def missing() -> Iterator[tuple[MappingSettings, U8]]:
        for frame in frames:
            check_size(frame, camera)
            names.append(frame.name)
            times.append(frame.time_ns)
            features = None
            if cache:
                keys.append(content.features_key(frame.image, how))
                features = cache.features(keys[-1])
            k = len(names) - 1
            if features is None:
                under_way.append(k)
                yield settings, frame.image
            else:
                keep(k, features)

    with Progress("features, images", total) as progress:
        for features in workers.map(extract_features, missing()):
            k = under_way.popleft()
            if cache:
                cache.keep_features(keys[k], features)
            keep(k, features)
    if len(names) < 2:
        raise InputError(f"a map needs at least 2 frames; the input has {len(names)}")
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two frames are named '{twice}'")
    described = [in_memory[k] for k in range(len(names))] if kept is None else kept.close()
    return Images(
        names=names,
        time_ns=np.array(times, dtype=np.int64),
        features=described,
        pinhole_px=[pixels[k] for k in range(len(names))],
        keys=keys,
    )


def extract_features(settings: MappingSettings, image: U8) -> Features:
    """The features of a grey image (H, W), by an extractor that each thread has for itself."""
    if getattr(_LOCAL, "settings", None) != settings:
        _LOCAL.extractor, _LOCAL.settings = extractor_of(settings), settings
    extractor: Extractor = _LOCAL.extractor
    return extractor.extract(image)


def extractor_of(settings: MappingSettings) -> Extractor:
    """As the settings say. A network gets one thread: pictures are described beside each other."""
    return extractors.create(settings.features, settings.max_features, learned=settings.learned)


def check_size(frame: Frame, camera: Camera) -> None:
    """Raises `MapError` for a picture that has not the camera's size."""
    if frame.image.shape != (camera.height_px, camera.width_px):
        height, width = frame.image.shape[:2]
        raise MapError(f"{frame.name}: is {misfit(camera, width, height)}")
