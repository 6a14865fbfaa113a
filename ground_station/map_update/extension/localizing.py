"""An input that is to join a map, localized in it frame by frame: where its frames are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ground_station.arrays import I64
from ground_station.errors import InputError, MapError
from ground_station.geometry.camera import Camera
from ground_station.localization.estimate import PoseEstimate
from ground_station.localization.extraction import extractor_for
from ground_station.localization.localizer import Localizer
from ground_station.localization.results import flight_observations
from ground_station.localization.settings import LocalizerSettings
from ground_station.map.observations import FlightObservations
from ground_station.map.store import Map
from ground_station.progress import Progress
from ground_station.recording.frames import FrameRange, FrameSource
from ground_station.recording.open import open_input


@dataclass(frozen=True)
class LocatedFlight:
    """An input and what a localizer made of it.

    `source` gives the frames once more; `time_ns` (N,), of all of them, increasing; `seen`, those
    that were tracked and what they saw; `localized` counts the frames that were solved at all;
    `distance_scale` is the extractor's.
    """

    path: Path
    source: FrameSource
    camera: Camera
    time_ns: I64
    seen: FlightObservations
    localized: int
    distance_scale: float

    @property
    def name(self) -> str:
        """What its keyframes' names begin with."""
        return self.seen.name


def localize(
    path: str | Path,
    map_: Map,
    settings: LocalizerSettings,
    *,
    camera: Camera | None = None,
    rate_hz: float | None = None,
    frame_range: FrameRange | None = None,
) -> LocatedFlight:
    """Localizes every frame of a recording, video or folder.

    `camera` instead of the input's own, which else is the map's where it has none. A recording that
    is cut gives the frames before the cut and says so in `source.notes`. Raises `MapError` when the
    camera's size is not the map's, its features are not here, or no frame could be localized.
    """
    path = Path(path)
    source = open_input(path, rate_hz, frame_range)
    camera = camera or source.camera or map_.info.camera
    _check_size(path, (camera.width_px, camera.height_px), map_)
    extractor = extractor_for(map_.info, settings.features)
    localizer = Localizer(map_, camera, extractor, settings)
    camera = localizer.camera  # the map's, where its pictures denied this one
    estimates: list[PoseEstimate] = []
    try:
        with Progress(f"localizing {path.name}, frames", source.count()) as progress:
            for frame in source:
                height, width = frame.image.shape
                _check_size(path, (width, height), map_)
                estimates.append(
                    localizer.process(frame.time_ns, frame.image, frame.index, frame.exposure_s)
                )
                progress.step()
    finally:
        localizer.finish()
    if not estimates:
        raise InputError(f"{path}: it holds no frames in this range")
    seen = flight_observations(estimates, path.resolve().stem, map_, camera)
    if not len(seen):
        raise MapError(
            f"{path}: none of its {len(estimates)} frames could be localized in the map "
            f"'{map_.info.name}', so that nothing ties it to the map"
        )
    times = np.array([estimate.time_ns for estimate in estimates], np.int64)
    # What falls back in time was refused by the localizer as well.
    later = times > np.concatenate([[times[0] - 1], np.maximum.accumulate(times)[:-1]])
    localized = sum(estimate.localized for estimate in estimates)
    return LocatedFlight(
        path, source, camera, times[later], seen, localized, extractor.distance_scale
    )


def _check_size(path: Path, size: tuple[int, int], map_: Map) -> None:
    wanted = map_.info.camera.width_px, map_.info.camera.height_px
    if size != wanted:
        raise MapError(
            f"{path}: its frames have {size[0]}x{size[1]} px, "
            f"the camera of the map '{map_.info.name}' {wanted[0]}x{wanted[1]} px"
        )
