"""The border to COLMAP: its models in memory and on disk.

Pixels of COLMAP count from the corner of the top-left pixel, half a pixel more than ours, and are
those of the picture, where each has the same noise: that stays behind this border and that of its
database. Outside, key points are undistorted.
"""

from __future__ import annotations

# pycolmap's wheel exports zlib symbols that corrupt PNG writing unless zlib and OpenCV come first.
import zlib  # noqa: F401  # isort: skip
import cv2  # noqa: F401  # isort: skip

import signal
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap as pycolmap  # others have it from here, after zlib

from ground_station.arrays import F64
from ground_station.errors import CameraError, MapError
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import MODELS
from ground_station.map.colmap_files import check
from ground_station.map.model import Model
from pi_firmware.wire import config
from pi_firmware.wire.errors import ConfigError

if threading.current_thread() is threading.main_thread():
    # pycolmap takes a build that is told to end for a crash of its own, with a trace of the stack.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

CAMERA_ID = 1
HALF_PIXEL = 0.5

_ORDER = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""COLMAP's parameters; the lens is OpenCV's polynomial or its fisheye."""
_OURS = {"opencv5": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE"}
_RATIONAL = ("k4", "k5", "k6")
"""Of `FULL_OPENCV`, what our five-parameter lens does not have."""

Reconstruction = pycolmap.Reconstruction


def quiet() -> None:
    """Silences COLMAP's own log."""
    # Progress and errors are ours to tell; COLMAP's own log goes to standard error by default.
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)


def camera_of(theirs: pycolmap.Camera) -> Camera:
    """COLMAP's camera as ours; raises `CameraError` or `ConfigError` for what ours cannot be."""
    name = theirs.model.name
    if name not in _ORDER:
        raise CameraError(f"it has the model {name}; what can be taken over is {', '.join(_ORDER)}")
    given = dict(zip(_ORDER[name].split(), theirs.params, strict=True))
    fisheye = name == "OPENCV_FISHEYE"
    others = () if fisheye else _RATIONAL
    rational = {k: given.pop(k) for k in others if k in given}
    if any(rational.values()):
        numbers = ", ".join(f"{k} {value:.3g}" for k, value in rational.items())
        raise CameraError(f"{name} with {numbers}; only 0 can be taken over")
    if "f" in given:
        given["fx"] = given["fy"] = given.pop("f")
    model = "fisheye" if fisheye else "opencv5"
    lens = {k: given[k] for k in MODELS[model].NAMES if k in given}
    values = {
        "model": model,
        "width_px": theirs.width,
        "height_px": theirs.height,
        "fx_px": given["fx"],
        "fy_px": given["fy"],
        "cx_px": given["cx"] - HALF_PIXEL,
        "cy_px": given["cy"] - HALF_PIXEL,
    }
    return config.from_mapping(values | lens, Camera, where=name)


def described(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model that has our camera's lens, and its parameters; the readout has no place."""
    values = {
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px + HALF_PIXEL,
        "cy": camera.cy_px + HALF_PIXEL,
    } | dict(zip(camera.lens.NAMES, camera.distortion.tolist(), strict=True))
    model = "PINHOLE" if camera.is_pinhole else _OURS[camera.model]
    return model, [values.get(name, 0.0) for name in _ORDER[model].split()]


def colmap_camera(ours: Camera, level: float = 1.0, camera_id: int = CAMERA_ID) -> pycolmap.Camera:
    """Our camera as COLMAP's, with pixels that are 1 / `level` as large."""
    model, params = described(ours)
    return pycolmap.Camera(
        camera_id=camera_id,
        model=model,
        width=int(np.ceil(level * ours.width_px)),
        height=int(np.ceil(level * ours.height_px)),
        params=[level * value for value in params[:4]] + params[4:],
        has_prior_focal_length=True,
    )


def pixels_of(camera: Camera, pinhole_px: F64) -> F64:
    """COLMAP's pixels (N, 2) of undistorted ones (N, 2)."""
    if camera.is_pinhole:
        return pinhole_px + HALF_PIXEL
    flat = (pinhole_px - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    return camera.distort(flat) + HALF_PIXEL


def from_arrays(
    model: Model,
    camera: Camera,
    weight: F64 | None = None,
    keypoints_px: Sequence[F64] | None = None,
) -> Reconstruction:
    """A reconstruction of a model's arrays, image k with id `image_id[k]`.

    `feature` is made again, unless all key points of each image (N, 2), undistorted, are given.

    COLMAP's adjustment has one loss for all observations. So `weight` (K,) of the images becomes a
    camera for each weight whose pixels are so much smaller: the same rays, with residuals scaled.
    Without it there is one camera, that of the database."""
    weights = np.ones(len(model.names)) if weight is None else np.asarray(weight, np.float64)
    levels, level_of = np.unique(weights, return_inverse=True)
    result = pycolmap.Reconstruction()
    for number, level in enumerate(levels.tolist()):
        result.add_camera_with_trivial_rig(colmap_camera(camera, level, CAMERA_ID + number))
    order = np.argsort(model.image, kind="stable")
    offset = np.searchsorted(model.image[order], np.arange(len(model.names) + 1))
    place = model.feature
    if keypoints_px is None:
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order)) - offset[model.image[order]]
    cTw = np.linalg.inv(model.wTc) if len(model.wTc) else model.wTc
    for k, name in enumerate(model.names):
        mine = order[offset[k] : offset[k + 1]]
        seen = model.pixel_px[mine] if keypoints_px is None else keypoints_px[k]
        pixels = pixels_of(camera, seen) * weights[k]
        result.add_image_with_trivial_frame(
            pycolmap.Image(
                name=name,
                keypoints=pixels,
                camera_id=CAMERA_ID + int(level_of[k]),
                image_id=int(model.image_id[k]),
            ),
            pycolmap.Rigid3d(cTw[k, :3]),
        )
    by_point = np.argsort(model.point, kind="stable")
    tracks = np.searchsorted(model.point[by_point], np.arange(len(model.position) + 1)).tolist()
    observations = np.stack([model.image_id[model.image], place], axis=1)[by_point]
    for m, point_id in enumerate(model.point_id.tolist()):
        mine = observations[
            tracks[m] : tracks[m + 1]
        ].tolist()  # all of them as lists would be large
        track = [pycolmap.TrackElement(*observation) for observation in mine]
        point = pycolmap.Point3D(xyz=model.position[m], track=pycolmap.Track(track))
        result.add_point3D_with_id(point_id, point)
    return result


def positions(reconstruction: Reconstruction, model: Model) -> tuple[F64, F64]:
    """Where a reconstruction has a model's images, wTc (K, 4, 4), and its points (M, 3)."""
    wTc = np.tile(np.eye(4), (len(model.names), 1, 1))
    for k, image_id in enumerate(model.image_id.tolist()):
        wTc[k, :3] = reconstruction.images[image_id].cam_from_world().inverse().matrix()
    points = [reconstruction.points3D[point_id].xyz for point_id in model.point_id.tolist()]
    return wTc, np.array(points).reshape(-1, 3)


def to_arrays(model: Reconstruction) -> Model:
    """A model as arrays; raises `MapError` for a camera that ours cannot be."""
    ids = sorted(model.reg_image_ids())
    point_ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    position = np.array([model.points3D[int(i)].xyz for i in point_ids]).reshape(-1, 3)
    wTc = np.tile(np.eye(4), (len(ids), 1, 1))
    names, images, features, seen, pixels = [], [], [], [], []
    for k, image_id in enumerate(ids):
        image = model.images[image_id]
        names.append(image.name)
        wTc[k, :3] = image.cam_from_world().inverse().matrix()
        index = np.asarray(image.get_observation_point2D_idxs(), dtype=np.int64)
        points = image.get_observation_points2D()
        images.append(np.full(len(index), k))
        features.append(index)
        seen.append(np.array([point.point3D_id for point in points], dtype=np.int64))
        pixels.append(np.array([point.xy for point in points]).reshape(-1, 2) - HALF_PIXEL)
    camera = _our_camera(model)
    return Model(
        names=names,
        image_id=np.array(ids, dtype=np.int64),
        wTc=wTc,
        point_id=point_ids,
        position=position,
        image=np.concatenate(images).astype(np.int64),
        feature=np.concatenate(features).astype(np.int64),
        point=np.searchsorted(point_ids, np.concatenate(seen)),
        pixel_px=camera.undistort_to_pinhole(np.concatenate(pixels)),
        camera=camera,
    )


def _our_camera(model: Reconstruction) -> Camera:
    try:
        return camera_of(model.cameras[CAMERA_ID])
    except (CameraError, ConfigError) as error:
        raise MapError(f"camera {CAMERA_ID}: {error}") from None


def copied(model: Reconstruction) -> Reconstruction:
    """A model of its own that is the same."""
    return pycolmap.Reconstruction(model)


def drop_images(model: Reconstruction, image_ids: npt.ArrayLike) -> None:
    """Takes images out of a model, with their observations."""
    for image_id in np.asarray(image_ids).tolist():
        model.deregister_frame(model.images[image_id].frame_id)


def drop_observations(
    model: Reconstruction, image_ids: npt.ArrayLike, features: npt.ArrayLike
) -> None:
    """Takes observations out of a model; a point that keeps only one goes, too."""
    pairs = zip(np.asarray(image_ids).tolist(), np.asarray(features).tolist(), strict=True)
    for image_id, feature in pairs:
        if model.images[image_id].points2D[feature].has_point3D():
            model.delete_observation(image_id, feature)


def drop_points(model: Reconstruction, point_ids: npt.ArrayLike) -> None:
    """Takes points out of a model; those that went with their observations are gone already."""
    for point_id in np.asarray(point_ids).tolist():
        if model.exists_point3D(point_id):
            model.delete_point3D(point_id)


def transform(model: Reconstruction, scale: float, rotation: F64, translation: F64) -> None:
    """Moves a model by x ↦ scale · rotation · x + translation; (3, 3), (3,)."""
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation))


def write(model: Reconstruction, folder: Path) -> None:
    """Writes the binary files of a model into a folder; raises `MapError` when the disk is full."""
    quiet()
    folder.mkdir(parents=True, exist_ok=True)
    model.update_point_3d_errors()
    model.write(folder)
    # COLMAP does not look whether the disk took it. By its format a point has 51 bytes, and 8 for
    # each of its observations, behind the count of points.
    points = folder / "points3D.bin"
    wanted = 8 + 51 * model.num_points3D() + 8 * model.compute_num_observations()
    if points.stat().st_size != wanted:
        raise MapError(f"{points}: was not written whole; is the disk full?")


def reread(folder: Path) -> Reconstruction:
    """Reads a model that this program has written or checked."""
    quiet()
    return pycolmap.Reconstruction(folder)


def read(folder: Path) -> Reconstruction:
    """Reads a map's model; raises `MapError` with one line."""
    check(folder)
    model = reread(folder)
    if CAMERA_ID not in model.cameras:
        raise MapError(f"{folder}: not a map's model: it has no camera {CAMERA_ID}")
    try:
        _our_camera(model)
    except MapError as error:
        raise MapError(f"{folder}: {error}") from None
    return model
