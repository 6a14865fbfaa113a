"""The frames of a build as features: what is kept of each image."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.errors import InputError, MapError
from ground_station.features import extractors
from ground_station.features.extractor import Extractor, Features
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.workers import parallel
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress
from ground_station.recording.frames import Frame

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Images:
    """What is kept of n frames: names, times (n,), features, their undistorted pixels (N, 2)."""

    names: list[str]
    time_ns: I64
    features: list[Features]
    pinhole_px: list[F64]


def extract(
    frames: Iterable[Frame],
    camera: Camera,
    settings: MappingSettings,
    threads: int,
    total: int | None,
) -> Images:
    """Features of all frames, extracted in parallel while the input is read.

    Raises `InputError` for fewer than two frames, `MapError` for a size other than the camera's.
    """
    local = threading.local()
    size = (camera.height_px, camera.width_px)

    def one(frame: Frame) -> tuple[str, int, Features]:
        if frame.image.shape != size:
            height, width = frame.image.shape[:2]
            raise MapError(
                f"{frame.name}: is {width}x{height} pixels, "
                f"the camera {camera.width_px}x{camera.height_px}"
            )
        if not hasattr(local, "extractor"):  # an extractor of its own for each thread
            local.extractor = extractor_of(settings)
        return frame.name, frame.time_ns, local.extractor.extract(frame.image)

    rows: list[tuple[str, int, Features]] = []
    with Progress("features, images", total) as progress:
        for row in parallel(one, frames, threads):
            rows.append(row)
            progress.step()
    if len(rows) < 2:
        raise InputError(f"a map needs at least 2 frames; the input has {len(rows)}")
    names = [row[0] for row in rows]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two frames are named '{twice}'")
    return Images(
        names=names,
        time_ns=np.array([row[1] for row in rows], dtype=np.int64),
        features=[row[2] for row in rows],
        pinhole_px=[camera.undistort_to_pinhole(row[2].keypoints_px) for row in rows],
    )


def extractor_of(settings: MappingSettings) -> Extractor:
    """As the settings say. A network gets one thread: pictures are described beside each other."""
    return extractors.create(settings.features, settings.max_features, learned=settings.learned)
