"""Models that COLMAP or hloc made: their poses and camera in our conventions."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64
from ground_station.errors import CameraError, MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map import colmap_files
from ground_station.map.colmap_cameras import camera_of
from ground_station.map.colmap_files import NO_POINT, CameraEntry, ImageEntry
from ground_station.mapping.sfm import colmap_text
from pi_firmware.wire.errors import ConfigError


@dataclass(frozen=True)
class ForeignModel:
    """A COLMAP model as others made it, in our conventions.

    `names`, K images, sorted; `wTc` (K, 4, 4) in the model's own units; `camera`, the one that took
    them all; `points`, K arrays of the numbers of the points that each image sees, sorted.
    """

    names: list[str]
    wTc: F64
    camera: Camera
    points: list[npt.NDArray[np.uint64]]


def read(folder: str | Path) -> ForeignModel:
    """Reads a COLMAP model, binary or text; raises `MapError` with one line naming what is wrong.

    Refused are lenses that neither OpenCV's five parameters nor its fisheye hold, and images of
    several cameras.
    """
    folder = Path(folder)
    if (folder / "cameras.bin").exists():
        cameras, images = colmap_files.read(folder)
    elif (folder / "cameras.txt").exists():
        cameras, images = colmap_text.read(folder)
    else:
        raise MapError(f"{folder}: not a COLMAP model: no cameras.bin or cameras.txt in it")
    if not images:
        raise MapError(f"{folder}: the model has no images")
    _check_names(folder, images)
    entries = sorted(images.values(), key=lambda image: image.name)
    values = np.array([entry.pose for entry in entries])
    cRw = Rotation.from_quat(np.roll(values[:, :4], -1, axis=1)).as_matrix()
    seen = [np.unique(entry.points[entry.points != NO_POINT]) for entry in entries]
    return ForeignModel(
        names=[entry.name for entry in entries],
        wTc=poses.inverse(poses.pose(cRw, values[:, 4:])),
        camera=_only_camera(folder, cameras, entries),
        points=seen,
    )


def _check_names(folder: Path, images: dict[int, ImageEntry]) -> None:
    times = Counter(image.name for image in images.values())
    for name, count in times.items():
        if count > 1:
            raise MapError(f"{folder}: the model has two images named {name!r:.80}")
        parts = Path(name).parts
        if not name.isprintable() or not parts or Path(name).is_absolute() or ".." in parts:
            raise MapError(f"{folder}: the model has an image named {name!r:.80}")


def _only_camera(folder: Path, cameras: dict[int, CameraEntry], images: list[ImageEntry]) -> Camera:
    """Also that of a model that repeats it for every image."""
    used = sorted({image.camera for image in images})
    first = cameras[used[0]]
    for number in used[1:]:
        if cameras[number] != first:
            raise MapError(
                f"{folder}: the model's images are of {len(used)} cameras ({used[0]} and {number} "
                "differ); a map is of one: let COLMAP take one camera for all images"
            )
    try:
        return camera_of(first)
    except (CameraError, ConfigError) as error:
        raise MapError(f"{folder}: camera {used[0]}: {error}") from None
