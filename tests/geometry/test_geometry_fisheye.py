"""The fisheye against OpenCV's, over all of its field, and what is said of wrong numbers."""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.geometry.lens_models import WIDEST

EQUIDISTANT = Camera(
    fx_px=244.4, fy_px=245.1, cx_px=317.2, cy_px=241.9, model="fisheye",
)  # fmt: skip
USUAL = replace(EQUIDISTANT, k1=-0.021, k2=0.0043, k3=-0.0012, k4=0.0002)
FOLDING = replace(EQUIDISTANT, k1=-0.09)
"""Turns back at 110° from its axis."""
NARROW = replace(USUAL, fx_px=700.0, fy_px=700.0)
"""Less than 65° from the axis in every corner."""
BENT = replace(THESIS_CAMERA, p1=0.02, k3=0.1)
LENSES = [EQUIDISTANT, USUAL, FOLDING, NARROW]
CAMERAS = pytest.mark.parametrize("camera", LENSES)


def directions(most_deg: float, n: int = 2000) -> np.ndarray:
    rng = np.random.default_rng(3)
    angle, turn = rng.uniform(0, math.radians(most_deg), n), rng.uniform(0, 2 * np.pi, n)
    aside = np.sin(angle)
    return np.stack([aside * np.cos(turn), aside * np.sin(turn), np.cos(angle)], axis=1)


def picture(camera: Camera) -> np.ndarray:
    u, v = np.meshgrid(
        np.linspace(0, camera.width_px - 1, 65), np.linspace(0, camera.height_px - 1, 49)
    )
    return np.stack([u.ravel(), v.ravel()], axis=1)


@CAMERAS
def test_projection_is_opencvs(camera: Camera) -> None:
    points = directions(89.0) * np.random.default_rng(1).uniform(0.3, 30, (2000, 1))
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion
    )
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-8)
    flat = points[:, :2] / points[:, 2:]
    np.testing.assert_allclose(camera.distort(flat), expected[:, 0], atol=1e-8)


@CAMERAS
def test_undistortion_is_opencvs(camera: Camera) -> None:
    pixels = picture(camera)
    pixels = pixels[camera.uses(pixels)]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    expected = cv2.fisheye.undistortPoints(
        pixels[:, None], camera.matrix, camera.distortion, None, None, None, criteria
    )[:, 0]
    np.testing.assert_allclose(camera.undistort(pixels), expected, atol=1e-8)
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-7)


@CAMERAS
def test_every_direction_that_the_lens_sees_comes_back_also_behind_the_plane(
    camera: Camera,
) -> None:
    fold = camera.lens.fold
    rays = directions(min(math.degrees(fold) - 0.5, 179.0))
    pixels = camera.project(rays)
    assert np.isfinite(pixels).all()
    np.testing.assert_allclose(camera.rays(pixels), rays, atol=1e-8)


def test_beyond_where_the_polynomial_turns_back_there_is_no_pixel_and_no_ray() -> None:
    fold = FOLDING.lens.fold
    assert math.radians(90) < fold < math.radians(130)
    past = [[math.sin(fold + 0.05), 0, math.cos(fold + 0.05)]]
    assert np.isnan(FOLDING.project(past)).all()
    rim = FOLDING.cx_px + FOLDING.fx_px * FOLDING.lens.radius(np.array(fold))
    assert np.isfinite(FOLDING.rays([[rim - 0.1, FOLDING.cy_px]])).all()
    assert np.isnan(FOLDING.rays([[rim + 0.1, FOLDING.cy_px]])).all()


@CAMERAS
def test_what_is_farther_than_the_widest_is_not_used(camera: Camera) -> None:
    pixels = picture(camera)
    rays = camera.rays(pixels)
    angle = np.arccos(np.clip(rays[:, 2] / np.linalg.norm(rays, axis=1), -1, 1))
    used = camera.uses(pixels)
    np.testing.assert_array_equal(used, angle < WIDEST)
    np.testing.assert_array_equal(np.isfinite(camera.undistort(pixels)).all(axis=1), used)
    assert used.all() == (camera == NARROW)
    drawn = camera.drawn_in(pixels)
    assert camera.uses(drawn).all()
    np.testing.assert_allclose(drawn[used], pixels[used], atol=1e-9)


@CAMERAS
def test_inside_is_what_is_used_and_in_the_picture(camera: Camera) -> None:
    rays = directions(89.5, 20_000)
    pixels = camera.project(rays)
    size = [camera.width_px - 0.5, camera.height_px - 0.5]
    expected = (rays[:, 2] > math.cos(WIDEST)) & ((pixels >= -0.5) & (pixels < size)).all(axis=1)
    np.testing.assert_array_equal(camera.inside(rays[:, :2] / rays[:, 2:]), expected)
    assert math.isfinite(camera.max_radius)


@pytest.mark.parametrize("camera", [*LENSES, THESIS_CAMERA, BENT])
def test_the_stretch_is_the_derivative_of_undistortion(camera: Camera) -> None:
    pixels = picture(camera)
    pixels = pixels[camera.uses(pixels + 2) & camera.uses(pixels - 2)]
    h, focal = 1e-4, np.array([camera.fx_px, camera.fy_px])
    bent = (pixels - [camera.cx_px, camera.cy_px]) / focal

    def unbent(offset):
        return camera.undistort((bent + offset) * focal + [camera.cx_px, camera.cy_px])

    across = [(unbent(step) - unbent(-step)) / (2 * h) for step in h * np.eye(2)]
    rms = np.sqrt(sum((column**2).sum(axis=1) for column in across) / 2)
    stretch = camera.stretch(camera.undistort_to_pinhole(pixels))
    np.testing.assert_allclose(stretch, rms, rtol=1e-4)


def test_beyond_where_the_polynomial_turns_back_the_stretch_stays_finite() -> None:
    far = np.linspace(0, 4000, 400)
    stretch = THESIS_CAMERA.stretch(np.stack([far, far], axis=1))
    assert np.isfinite(stretch).all() and (stretch > 0).all()


def test_rows_are_the_pictures() -> None:
    pixels = picture(USUAL)
    pixels = pixels[USUAL.uses(pixels)]
    np.testing.assert_allclose(
        USUAL.rows(USUAL.undistort_to_pinhole(pixels)), pixels[:, 1], atol=1e-9
    )


def test_the_file_holds_the_models_own_keys_and_old_files_are_as_they_were() -> None:
    assert "p1" not in USUAL.as_dict() and USUAL.as_dict()["k4"] == 0.0002
    assert Camera(**USUAL.as_dict()) == USUAL
    assert list(THESIS_CAMERA.as_dict()) == [
        "width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px",
        "k1", "k2", "p1", "p2", "k3", "readout_s", "model",
    ]  # fmt: skip
    assert asdict(THESIS_CAMERA)["k4"] == 0
