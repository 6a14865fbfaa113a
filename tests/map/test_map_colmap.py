"""COLMAP's side of the border sees pictures as the camera takes them; ours lives on the plane."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_made import model_of

from ground_station.errors import MapError
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.map import colmap, landmarks
from ground_station.map.model import Model

PINHOLE = Camera(fx_px=320.0, fy_px=322.0)
WIDE = Camera(fx_px=210.0, fy_px=211.0, k1=0.2, k2=-0.21, p1=7e-4, p2=8e-4, k3=0.05)
FISHEYE = Camera(fx_px=240.0, fy_px=241.0, k1=0.02, k2=-0.004, k4=2e-4, model="fisheye")
LENSES = pytest.mark.parametrize("camera", [PINHOLE, WIDE, FISHEYE])


def seen(camera: Camera, noise_px: float) -> tuple[Model, np.ndarray]:
    """Two cameras and points all over their pictures; where the points are in them, with noise."""
    rng = np.random.default_rng(3)
    v, u = np.mgrid[10:470:24, 10:630:24]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    rays = camera.undistort(pixels[camera.uses(pixels)])
    points = np.column_stack([rays, np.ones(len(rays))]) * rng.uniform(3.0, 6.0, (len(rays), 1))
    wTc = np.tile(np.eye(4), (2, 1, 1))
    wTc[1, 0, 3] = 0.02
    picture = np.concatenate([camera.project(points - T[:3, 3]) for T in wTc])
    picture += noise_px * rng.normal(size=picture.shape)
    use = camera.uses(picture)
    image, point = np.divmod(np.arange(2 * len(points)), len(points))
    used, point = np.unique(point[use], return_inverse=True)
    model = model_of(
        camera, wTc, points[used], image=image[use], point=point.ravel(),
        pixel_px=camera.undistort_to_pinhole(picture[use]),
    )  # fmt: skip
    return model, picture[use]


@LENSES
def test_colmap_has_the_pictures_pixels_and_their_camera(camera: Camera, tmp_path: Path) -> None:
    model, picture = seen(camera, 0.0)
    colmap.write(colmap.from_arrays(model, camera), tmp_path)
    theirs = colmap.read(tmp_path)
    image = theirs.images[1]
    points = model.position[model.point[model.image == 0]]
    projected = np.array([image.project_point(each) for each in points])
    np.testing.assert_allclose(projected - 0.5, picture[model.image == 0], atol=1e-6)
    again = colmap.to_arrays(theirs)
    assert again.camera == camera
    np.testing.assert_allclose(again.pixel_px, model.pixel_px, atol=1e-6)


@LENSES
def test_residuals_are_the_pictures_pixels_to_the_border(camera: Camera) -> None:
    model, picture = seen(camera, 0.5)
    size = np.linalg.norm(landmarks.residuals_px(model), axis=1)
    outside = np.hypot(*((picture - [camera.cx_px, camera.cy_px]) / [320.0, 240.0]).T) > 1.0
    for some in (outside, ~outside):
        assert np.sqrt(np.mean(size[some] ** 2) / 2) == pytest.approx(0.5, rel=0.1)


def test_an_image_that_weighs_less_has_the_same_rays(tmp_path: Path) -> None:
    model, picture = seen(WIDE, 0.0)
    theirs = colmap.from_arrays(model, WIDE, np.array([1.0, 0.5]))
    for number, level in ((1, 1.0), (2, 0.5)):
        image = theirs.images[number]
        mine = model.image == number - 1
        pixels = np.array([image.project_point(each) for each in model.position[model.point[mine]]])
        np.testing.assert_allclose(pixels, level * (picture[mine] + 0.5), atol=1e-6)


def test_a_camera_that_ours_cannot_be_is_refused_in_one_line(tmp_path: Path) -> None:
    theirs = colmap.from_arrays(seen(THESIS_CAMERA, 0.0)[0], THESIS_CAMERA)
    theirs.cameras[colmap.CAMERA_ID].params = [300.0, 300.0, 320.0, 240.0, *[0.1] * 8]
    with pytest.raises(MapError, match=r"^camera 1: [^\n]*k4[^\n]*$"):
        colmap.to_arrays(theirs)


def test_a_map_made_before_has_a_pinhole_and_undistorted_pixels() -> None:
    camera = replace(WIDE, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    model, _ = seen(camera, 0.0)
    theirs = colmap.from_arrays(model, camera)
    assert theirs.cameras[colmap.CAMERA_ID].model.name == "PINHOLE"
    np.testing.assert_allclose(colmap.to_arrays(theirs).pixel_px, model.pixel_px, atol=1e-9)


def test_a_build_that_is_told_to_end_does_so_without_a_trace() -> None:
    told = "import os, signal; from ground_station.map import colmap; os.kill(os.getpid(), 15)"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")
