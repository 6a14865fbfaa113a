"""A camera follows its pictures when they are scaled or turned, and is refused where it cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ground_station.errors import CameraError
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.geometry.resizing import for_pictures, misfit, scaled, turned

RAYS = np.random.default_rng(3).uniform(-0.4, 0.4, (50, 2))


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (160, 120)])
def test_scaled_pixels_keep_their_place_from_the_pictures_border(size: tuple[int, int]) -> None:
    """The first pixel's centre is (0, 0), so that the border is at -1/2, before and after."""
    s = size[0] / 640
    pixels = scaled(THESIS_CAMERA, *size).distort(RAYS)
    np.testing.assert_allclose(pixels + 0.5, s * (THESIS_CAMERA.distort(RAYS) + 0.5), atol=1e-9)


def test_a_scaled_camera_fits_pictures_that_opencv_scaled() -> None:
    """A blob's centre of mass in the smaller picture is where the scaled camera projects it."""
    import cv2

    camera = replace(THESIS_CAMERA, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    centre = camera.distort(np.array([[0.11, -0.07]]))[0]
    v, u = np.mgrid[0:480, 0:640]
    blob = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 9.0**2))
    small = cv2.resize(blob, (320, 240), interpolation=cv2.INTER_AREA)
    v, u = np.mgrid[0:240, 0:320]
    found = np.array([(small * u).sum(), (small * v).sum()]) / small.sum()
    wanted = scaled(camera, 320, 240).distort(np.array([[0.11, -0.07]]))[0]
    np.testing.assert_allclose(found, wanted, atol=0.01)


@pytest.mark.parametrize("quarters", [1, 2, 3, -1])
def test_a_turned_camera_sees_what_the_turned_picture_shows(quarters: int) -> None:
    """Numpy turns the picture; the ray turns about the axis; lens, centre and focal lengths too."""
    pixels = THESIS_CAMERA.distort(RAYS)
    height, width = 480, 640
    rays = RAYS.copy()
    for _ in range(quarters % 4):
        pixels = np.stack([height - 1 - pixels[:, 1], pixels[:, 0]], axis=1)
        rays = np.stack([-rays[:, 1], rays[:, 0]], axis=1)
        height, width = width, height
    camera = turned(THESIS_CAMERA, quarters)
    assert (camera.width_px, camera.height_px) == (width, height)
    np.testing.assert_allclose(camera.distort(rays), pixels, atol=1e-9)


def test_a_quarter_is_the_one_that_numpy_calls_clockwise() -> None:
    picture = np.zeros((480, 640), bool)
    picture[37, 421] = True
    v, u = np.argwhere(np.rot90(picture, -1))[0]
    ray = THESIS_CAMERA.undistort([[421.0, 37.0]])[0]
    seen = turned(THESIS_CAMERA, 1).distort([[-ray[1], ray[0]]])[0]
    np.testing.assert_allclose(seen, [u, v], atol=1e-6)


def test_four_quarters_change_nothing() -> None:
    camera = THESIS_CAMERA
    for _ in range(4):
        camera = turned(camera, 1)
    assert camera == THESIS_CAMERA


def test_a_camera_of_the_pictures_size_is_theirs_however_displays_turn_them() -> None:
    for display_deg in (0, 90, 180, 270):
        assert for_pictures(THESIS_CAMERA, (640, 480), display_deg, "a.mp4") == (THESIS_CAMERA, "")


@pytest.mark.parametrize("display_deg", [90, 270])
def test_a_camera_of_the_shown_pictures_is_turned_back_to_the_stored_ones(display_deg: int) -> None:
    shown = turned(THESIS_CAMERA, display_deg // 90)
    camera, said = for_pictures(shown, (640, 480), display_deg, "a.mp4")
    assert camera == THESIS_CAMERA
    assert said.startswith("a.mp4: ") and f"shown turned by {display_deg}°, as the" in said
    half, said = for_pictures(shown, (320, 240), display_deg, "a.mp4")
    assert half == scaled(THESIS_CAMERA, 320, 240) and said.endswith("and scaled")


@pytest.mark.parametrize("own", [(3840, 2160), (640, 360), (854, 480)])
def test_a_camera_of_another_size_and_the_same_shape_is_scaled_and_it_is_said(
    own: tuple[int, int],
) -> None:
    measured = scaled(Camera(1920, 1080, 1400.0, 1410.0, 950.0, 545.0), *own)
    camera, said = for_pictures(measured, (1920, 1080), 0, "a.mp4")
    assert camera.fx_px == pytest.approx(1400) and camera.fy_px == pytest.approx(1410)
    assert camera.cx_px == pytest.approx(950) and camera.cy_px == pytest.approx(545)
    assert "1920x1080" in said and f"{own[0]}x{own[1]}" in said and "scaled" in said


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((1920, 1080), r"^a\.mp4: .*1920x1080.*640x480, another shape.*calibrate at 1920x1080"),
        ((480, 640), r"^a\.mp4: .*480x640.*640x480.*turned by a quarter.*calibrate with pictures"),
        ((700, 480), r"another shape"),
    ],
)
def test_what_fits_neither_way_is_refused_with_what_to_do(
    size: tuple[int, int], words: str
) -> None:
    with pytest.raises(CameraError, match=words) as caught:
        for_pictures(THESIS_CAMERA, size, 180, "a.mp4")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((480, 640), "480x640 pixels, the camera 640x480: it stands upright, the camera's picture"),
        ((240, 320), "it stands upright"),
        ((320, 240), "use pictures of 640x480, or calibrate at 320x240"),
        ((640, 360), "use pictures of 640x480, or calibrate at 640x360"),
    ],
)
def test_a_picture_that_does_not_fit_says_how_it_would(size: tuple[int, int], words: str) -> None:
    assert words in misfit(THESIS_CAMERA, *size)
    lying = turned(THESIS_CAMERA, 1)
    assert "it lies, the camera's picture stands upright" in misfit(lying, 640, 480)
