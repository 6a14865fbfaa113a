"""The conftest's room as COLMAP models it, written by COLMAP's own library with a lens in it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ground_station.geometry import poses
from ground_station.map.colmap import pycolmap


def colmap_camera(camera, model="OPENCV", number=1):
    """Our camera as COLMAP's; k3 is in FULL_OPENCV only."""
    lens = [camera.k1, camera.k2, camera.p1, camera.p2]
    params = [camera.fx_px, camera.fy_px, camera.cx_px + 0.5, camera.cy_px + 0.5, *lens]
    if model == "FULL_OPENCV":
        params += [camera.k3, 0.0, 0.0, 0.0]
    return pycolmap.Camera(
        camera_id=number, model=model, width=camera.width_px, height=camera.height_px, params=params
    )


def image_name(k):
    """Of picture k, in a subfolder."""
    return f"db/walk-{k:02d}.png"


def foreign_model(scene, cameras=None):
    """All images of a scene, with key points of their own: the true pixels, in another order."""
    rng = np.random.default_rng(5)
    model = pycolmap.Reconstruction()
    cameras = cameras or [colmap_camera(scene.camera)]
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    tracks = {}
    for k, (wTc, seen) in enumerate(zip(scene.wTc, scene.seen, strict=True)):
        order = rng.permutation(seen)
        pixels = scene.camera.project(poses.transform(poses.inverse(wTc), scene.points[order]))
        image = pycolmap.Image(
            name=image_name(k),
            keypoints=pixels + 0.5,
            camera_id=cameras[k % len(cameras)].camera_id,
            image_id=k + 1,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses.inverse(wTc)[:3]))
        for place, point in enumerate(order.tolist()):
            tracks.setdefault(point, []).append(pycolmap.TrackElement(k + 1, place))
    for point, track in tracks.items():
        if len(track) > 1:
            whole = pycolmap.Point3D(xyz=scene.points[point], track=pycolmap.Track(track))
            model.add_point3D_with_id(point + 1, whole)
    return model


def write(model, folder: Path, kind: str) -> Path:
    """Its files, `binary` or `text`, without rigs and frames, as older programs write them."""
    folder.mkdir(parents=True)
    (model.write_binary if kind == "binary" else model.write_text)(folder)
    for path in folder.iterdir():
        if path.stem in ("rigs", "frames"):
            path.unlink()
    return folder


def write_pictures(scene, folder: Path) -> Path:
    """What `SceneExtractor` takes its number from, under the model's names."""
    for frame in scene.frames():
        path = folder / image_name(frame.index)
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), frame.image)
    return folder
