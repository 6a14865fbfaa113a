"""Models, tables and files made by hand, and commands called with a shell's words."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.geometry.camera import Camera
from ground_station.map.model import Model
from ground_station.map.store import Keyframes


def run(command: ModuleType, *words: object) -> int:
    """What the command of a module gives for these words; raises what it raises."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return int(command.run(parser.parse_args([str(word) for word in words])))


def content(folder: Path) -> dict[str, bytes]:
    """All files in a folder and below it, by name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def camera_file(path: Path, camera: Camera) -> str:
    """Writes a camera file; gives its path."""
    lines = (f"{key} = {value!r}\n" for key, value in camera.as_dict().items())
    path.write_text("".join(lines).replace("'", '"'))
    return str(path)


def model_of(camera: Camera, wTc: Any, position: Any, **observations: Any) -> Model:
    """A model of K poses and M points: `image`, `point` and `pixel_px` of its observations.

    Names and ids count the images and points, unless they are given, too.
    """
    count = len(wTc)
    fields: dict[str, Any] = {
        "names": [f"frame-{k:06d}" for k in range(count)],
        "image_id": np.arange(count) + 1,
        "wTc": np.array(wTc),
        "point_id": np.arange(len(position)) + 1,
        "position": np.array(position),
        "feature": np.zeros(len(observations["image"]), np.int64),
        "camera": camera,
    }
    return Model(**fields | observations)


def observed(
    camera: Camera, wTc: F64, points: F64, rows: Sequence[Sequence[Any]], least: int
) -> tuple[Model, Bools]:
    """The model of points (N, 3) that `least` of K images see, and which observations are of it.

    `rows` holds for each image the indices of what it sees, and their distorted pixels. Ids of
    points have gaps.
    """
    index, pixel = (np.concatenate([row[column] for row in rows]) for column in (0, 1))
    image = np.repeat(np.arange(len(rows)), [len(row[0]) for row in rows])
    often = np.bincount(index, minlength=len(points)) >= least
    used = often[index]
    model = model_of(
        camera, wTc, points[often],
        point_id=3 * np.flatnonzero(often) + 5, image=image[used],
        point=(np.cumsum(often) - 1)[index[used]],
        pixel_px=camera.undistort_to_pinhole(pixel[used]),
    )  # fmt: skip
    return model, used


def in_picture(camera: Camera, local: F64, pixel: F64, widest: float) -> Bools:
    """Which points (N, 3), in the camera's axes and at pixels (N, 2), a picture shows.

    `widest` is the tangent of the angle from the axis beyond which a lens would fold back.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = np.linalg.norm(local[:, :2], axis=1) / local[:, 2] < widest
        inside &= (local[:, 2] > 0.5) & (pixel > 0).all(axis=1)
        return inside & (pixel < [camera.width_px - 1, camera.height_px - 1]).all(axis=1)


def by_frame(rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """`offset`, `landmark` and `pixel_px` of a table, of `rows` as `observed` takes them."""
    index, pixel = (np.concatenate([row[column] for row in rows]) for column in (0, 1))
    return {
        "offset": np.cumsum([0, *(len(row[0]) for row in rows)]),
        "landmark": index.astype(np.int32),
        "pixel_px": pixel.astype(np.float32),
    }


def keyframes_of(wTc: F64, step_ns: int, **observations: Any) -> Keyframes:
    """Keyframes at poses (K, 4, 4), so far apart; by default they saw nothing."""
    count = len(wTc)
    none = {
        "offset": np.zeros(count + 1, np.int64),
        "landmark": np.empty(0, np.int32),
        "pixel_px": np.empty((0, 2), np.float32),
    }
    names = [f"frame-{k:06d}" for k in range(count)]
    return Keyframes(names, np.arange(count) * step_ns, np.array(wTc), **none | observations)


NO_KEYFRAMES = keyframes_of(np.empty((0, 4, 4)), 1)
