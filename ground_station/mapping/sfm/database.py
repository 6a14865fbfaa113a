"""COLMAP's database, which its structure from motion reads: key points and verified pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry.camera import Camera
from ground_station.map import colmap
from ground_station.map.colmap import HALF_PIXEL, pycolmap
from ground_station.mapping.sfm.two_view import TwoView
from pi_firmware.wire import files


def write_database(
    path: Path,
    camera: Camera,
    names: Sequence[str],
    keypoints_px: Sequence[F64],
    pairs: Mapping[tuple[int, int], TwoView],
) -> None:
    """Writes a COLMAP database: one camera, images with id = index + 1, verified pairs.

    `keypoints_px[i]` (N, 2) are image i's undistorted pixels; `pairs[i, j]` with i < j. It is
    written beside and renamed.
    """
    colmap.quiet()
    part = path.with_name(path.name + ".part")
    for left in part.parent.glob(part.name + "*"):  # SQLite's journals, too
        left.unlink()
    with pycolmap.Database.open(part) as database:
        taken_by = colmap.colmap_camera(camera)
        database.write_camera(taken_by, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(taken_by.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for i, (name, pixels) in enumerate(zip(names, keypoints_px, strict=True)):
            image = pycolmap.Image(name=name, camera_id=colmap.CAMERA_ID, image_id=i + 1)
            frame = pycolmap.Frame(frame_id=i + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_image(image, use_image_id=True)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(i + 1, colmap.pixels_of(camera, pixels).astype(np.float32))
        K = taken_by.calibration_matrix()
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
    files.replace(part, path)
