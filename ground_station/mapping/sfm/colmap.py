"""The border to COLMAP: its database, its models in memory and on disk.

This room alone imports pycolmap, and this module alone knows that COLMAP's pixels count from the
corner of the top-left pixel: half a pixel more than ours. Key points go in undistorted, so the
camera in there is a plain pinhole, whatever the lens.
"""

from __future__ import annotations

# pycolmap's wheel exports zlib symbols that corrupt PNG writing unless zlib and OpenCV come first.
import zlib  # noqa: F401  # isort: skip
import cv2  # noqa: F401  # isort: skip

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.geometry.camera import Camera
from ground_station.mapping.construction.matching import TwoView
from ground_station.mapping.sfm import colmap_files

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

HALF_PIXEL = 0.5
_CAMERA_ID = 1

Reconstruction = pycolmap.Reconstruction


@dataclass(frozen=True)
class Model:
    """A COLMAP model as arrays, in our conventions.

    `names`, K image names and `image_id` (K,) their ids, in order of id; `wTc` (K, 4, 4);
    `point_id` (M,), `position` (M, 3). Observation o is key point `feature[o]` of image `image[o]`
    (an index into `names`), a sight of point `point[o]` (an index into `point_id`), at
    `pixel_px[o]` (O, 2), undistorted pixels. `pinhole` is fx, fy, cx, cy in our pixels.
    """

    names: list[str]
    image_id: I64
    wTc: F64
    point_id: I64
    position: F64
    image: I64
    feature: I64
    point: I64
    pixel_px: F64
    pinhole: F64


def quiet() -> None:
    """Silences COLMAP's own log."""
    # Progress and errors are ours to tell; COLMAP's own log goes to standard error by default.
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)


def _pinhole(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=_CAMERA_ID,
        model="PINHOLE",
        width=camera.width_px,
        height=camera.height_px,
        params=[
            camera.fx_px,
            camera.fy_px,
            camera.cx_px + HALF_PIXEL,
            camera.cy_px + HALF_PIXEL,
        ],
        has_prior_focal_length=True,
    )


def write_database(
    path: Path,
    camera: Camera,
    names: Sequence[str],
    keypoints_px: Sequence[F64],
    pairs: Mapping[tuple[int, int], TwoView],
) -> None:
    """Writes a COLMAP database: one pinhole camera, images with id = index + 1, verified pairs.

    `keypoints_px[i]` (N, 2) are image i's undistorted pixels; `pairs[i, j]` with i < j. It is
    written beside and renamed.
    """
    quiet()
    part = path.with_name(path.name + ".part")
    for left in part.parent.glob(part.name + "*"):  # SQLite's journals, too
        left.unlink()
    with pycolmap.Database.open(part) as database:
        pinhole = _pinhole(camera)
        database.write_camera(pinhole, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(pinhole.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for i, (name, pixels) in enumerate(zip(names, keypoints_px, strict=True)):
            image = pycolmap.Image(name=name, camera_id=_CAMERA_ID, image_id=i + 1)
            frame = pycolmap.Frame(frame_id=i + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_image(image, use_image_id=True)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(i + 1, (pixels + HALF_PIXEL).astype(np.float32))
        K = pinhole.calibration_matrix()
        K_inv = np.linalg.inv(K)
        shift = np.array([[1.0, 0.0, HALF_PIXEL], [0.0, 1.0, HALF_PIXEL], [0.0, 0.0, 1.0]])
        kinds = pycolmap.TwoViewGeometryConfiguration
        for (i, j), view in pairs.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = kinds.PLANAR_OR_PANORAMIC if view.degenerate else kinds.CALIBRATED
            geometry.inlier_matches = view.matches.astype(np.uint32)
            geometry.E = view.essential
            geometry.F = K_inv.T @ view.essential @ K_inv
            if view.homography is not None:
                geometry.H = shift @ view.homography @ np.linalg.inv(shift)
            database.write_matches(i + 1, j + 1, view.matches.astype(np.uint32))
            database.write_two_view_geometry(i + 1, j + 1, geometry)
    part.replace(path)


def adjustment_options(
    loss_px: float, threads: int, max_iterations: int
) -> pycolmap.BundleAdjustmentOptions:
    """Of every bundle adjustment here: constant intrinsics, a Cauchy loss of scale `loss_px`."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads or -1
    options.ceres.solver_options.max_num_iterations = max_iterations
    options.ceres.solver_options.function_tolerance = 1e-6
    return options


def adjust(
    model: Reconstruction,
    *,
    loss_px: float,
    threads: int = 0,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
) -> bool:
    """Bundle adjustment of all poses and points with a Cauchy loss of scale `loss_px`.

    It ends when a step lowers the cost by no more than the share `tolerance`. Returns whether that
    was within `max_iterations`.
    """
    options = adjustment_options(loss_px, threads, max_iterations)
    options.ceres.solver_options.function_tolerance = tolerance
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return bool(summary.termination_type != pycolmap.BundleAdjustmentTerminationType.NO_CONVERGENCE)


def from_arrays(
    model: Model,
    camera: Camera,
    weight: F64 | None = None,
    keypoints_px: Sequence[F64] | None = None,
) -> Reconstruction:
    """A reconstruction of a model's arrays, image k with id `image_id[k]`.

    `feature` is made anew, unless all key points of each image (N, 2), undistorted, are given.

    COLMAP's adjustment has one loss for all sights. So `weight` (K,) of the images becomes a camera
    for each weight whose pixels are so much smaller: the same rays, with residuals scaled. Without
    it there is one camera, that of the database.
    """
    pinhole = _pinhole(camera)
    weights = np.ones(len(model.names)) if weight is None else np.asarray(weight, np.float64)
    levels, camera_of = np.unique(weights, return_inverse=True)
    result = pycolmap.Reconstruction()
    for number, level in enumerate(levels.tolist()):
        result.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=_CAMERA_ID + number,
                model="PINHOLE",
                width=int(np.ceil(level * camera.width_px)),
                height=int(np.ceil(level * camera.height_px)),
                params=level * np.asarray(pinhole.params),
                has_prior_focal_length=True,
            )
        )
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
        pixels = (seen + HALF_PIXEL) * weights[k]
        result.add_image_with_trivial_frame(
            pycolmap.Image(
                name=name,
                keypoints=pixels,
                camera_id=_CAMERA_ID + int(camera_of[k]),
                image_id=int(model.image_id[k]),
            ),
            pycolmap.Rigid3d(cTw[k, :3]),
        )
    by_point = np.argsort(model.point, kind="stable")
    tracks = np.searchsorted(model.point[by_point], np.arange(len(model.position) + 1)).tolist()
    sights = np.stack([model.image_id[model.image], place], axis=1)[by_point]
    for m, point_id in enumerate(model.point_id.tolist()):
        mine = sights[tracks[m] : tracks[m + 1]].tolist()  # all of them as lists would be large
        track = [pycolmap.TrackElement(*sight) for sight in mine]
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
    """A model as arrays; pixels lose COLMAP's half pixel here."""
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
    camera = model.cameras[_CAMERA_ID]
    return Model(
        names=names,
        image_id=np.array(ids, dtype=np.int64),
        wTc=wTc,
        point_id=point_ids,
        position=position,
        image=np.concatenate(images).astype(np.int64),
        feature=np.concatenate(features).astype(np.int64),
        point=np.searchsorted(point_ids, np.concatenate(seen)),
        pixel_px=np.concatenate(pixels),
        pinhole=np.asarray(camera.params) - [0.0, 0.0, HALF_PIXEL, HALF_PIXEL],
    )


def similarity(source: F64, target: F64, error: float, seed: int) -> Alignment | None:
    """The similarity by which most of source (N, 3) reach target (N, 3) within `error`, or None.

    LO-RANSAC: Chum, Matas and Kittler, "Locally optimized RANSAC", DAGM 2003.
    """
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = error, seed
    found: Any = pycolmap.estimate_sim3d_robust(source, target, options)  # a dict, or None
    if found is None:
        return None
    motion = found["tgt_from_src"]
    return Alignment(motion.rotation.matrix(), np.array(motion.translation), float(motion.scale))


def copied(model: Reconstruction) -> Reconstruction:
    """A model of its own that is the same."""
    return pycolmap.Reconstruction(model)


def drop_images(model: Reconstruction, image_ids: npt.ArrayLike) -> None:
    """Takes images out of a model, with their sights."""
    for image_id in np.asarray(image_ids).tolist():
        model.deregister_frame(model.images[image_id].frame_id)


def drop_observations(
    model: Reconstruction, image_ids: npt.ArrayLike, features: npt.ArrayLike
) -> None:
    """Takes sights out of a model; a point that keeps only one goes, too."""
    pairs = zip(np.asarray(image_ids).tolist(), np.asarray(features).tolist(), strict=True)
    for image_id, feature in pairs:
        if model.images[image_id].points2D[feature].has_point3D():
            model.delete_observation(image_id, feature)


def drop_points(model: Reconstruction, point_ids: npt.ArrayLike) -> None:
    """Takes points out of a model; those that went with their sights are gone already."""
    for point_id in np.asarray(point_ids).tolist():
        if model.exists_point3D(point_id):
            model.delete_point3D(point_id)


def compact(model: Reconstruction) -> Reconstruction:
    """A copy that holds the sights of points only, without the key points that none came of.

    Two thirds of a model's size on disk are key points without a point.
    """
    result = pycolmap.Reconstruction()
    result.add_camera_with_trivial_rig(model.cameras[_CAMERA_ID])
    place: dict[int, I64] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        kept = [int(i) for i in image.get_observation_point2D_idxs()]
        place[image_id] = np.full(len(image.points2D), -1, np.int64)
        place[image_id][kept] = np.arange(len(kept))
        pixels = np.array([image.points2D[i].xy for i in kept]).reshape(-1, 2)
        result.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name, keypoints=pixels, camera_id=_CAMERA_ID, image_id=image_id
            ),
            image.cam_from_world(),
        )
    for point_id in sorted(model.point3D_ids()):
        point = model.points3D[point_id]
        track = pycolmap.Track(
            [
                pycolmap.TrackElement(e.image_id, place[e.image_id][e.point2D_idx])
                for e in point.track.elements
            ]
        )
        moved = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
        result.add_point3D_with_id(point_id, moved)
    return result


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
    # each of its sights, behind the count of points.
    points = folder / "points3D.bin"
    wanted = 8 + 51 * model.num_points3D() + 8 * model.compute_num_observations()
    if points.stat().st_size != wanted:
        raise MapError(f"{points}: was not written whole; is the disk full?")


def reread(folder: Path) -> Reconstruction:
    """Reads a model that this program has written or checked."""
    quiet()
    return pycolmap.Reconstruction(folder)


def read(folder: Path) -> Reconstruction:
    """Reads a model; raises `MapError` with one line."""
    colmap_files.check(folder)
    try:
        return reread(folder)
    except (ValueError, RuntimeError, OSError, IndexError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MapError(f"{folder}: not a COLMAP model: {reason}") from None
