"""Models that COLMAP or hloc made: their poses and camera in our conventions."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.errors import CameraError, MapError
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.map import colmap, colmap_files
from ground_station.map.colmap import camera_of, pycolmap
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
    if not any((folder / f"cameras.{kind}").exists() for kind in ("bin", "txt")):
        raise MapError(f"{folder}: not a COLMAP model: no cameras.bin or cameras.txt in it")
    colmap_files.check(folder)
    model = colmap.reread(folder)
    images = sorted(model.images.values(), key=lambda image: image.name)
    if not images:
        raise MapError(f"{folder}: the model has no images")
    names = [image.name for image in images]
    _check_names(folder, names)
    cTw = np.tile(np.eye(4), (len(images), 1, 1))
    cTw[:, :3] = [image.cam_from_world().matrix() for image in images]
    return ForeignModel(
        names=names,
        wTc=poses.inverse(cTw),
        camera=_only_camera(folder, model, images),
        points=[_points_of(image) for image in images],
    )


def _points_of(image: pycolmap.Image) -> npt.NDArray[np.uint64]:
    seen = image.get_observation_points2D()
    return np.unique(np.array([point.point3D_id for point in seen], np.uint64))


def _check_names(folder: Path, names: list[str]) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise MapError(f"{folder}: the model has two images named {name!r:.80}")
        parts = Path(name).parts
        if not name.isprintable() or not parts or Path(name).is_absolute() or ".." in parts:
            raise MapError(f"{folder}: the model has an image named {name!r:.80}")


def _only_camera(
    folder: Path, model: colmap.Reconstruction, images: list[pycolmap.Image]
) -> Camera:
    """Also that of a model that repeats it for every image."""
    used = sorted({image.camera_id for image in images})
    cameras = [model.cameras[number] for number in used]
    told = [(each.model, each.width, each.height, *each.params) for each in cameras]
    for number, one in zip(used, told, strict=True):
        if one != told[0]:
            raise MapError(
                f"{folder}: the model's images are of {len(used)} cameras ({used[0]} and {number} "
                "differ); a map is of one: let COLMAP take one camera for all images"
            )
    try:
        return camera_of(cameras[0])
    except (CameraError, ConfigError) as error:
        raise MapError(f"{folder}: camera {used[0]}: {error}") from None
