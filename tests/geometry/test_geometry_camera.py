"""The lens model against OpenCV and GTSAM, and camera files that are wrong."""

from __future__ import annotations

from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_station.errors import CameraError
from ground_station.geometry.camera import THESIS_CAMERA, Camera, load_camera

WIDE = Camera(k1=-0.28, k2=0.09, p1=0.0004, p2=-0.0007, k3=-0.013)
CAMERAS = pytest.mark.parametrize("camera", [THESIS_CAMERA, WIDE, Camera()])
GOOD = """\
width_px = 640
height_px = 480
fx_px = 500.0
fy_px = 501
cx_px = 319.5
cy_px = 239.5
k1 = 0.1
"""
FISHEYES = 'model = "fisheye"\n' + GOOD.replace("k1 = 0.1", "k1 = -0.02\nk4 = 0.001")


def points_in_view(n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(5)
    xy = rng.uniform([-0.6, -0.45], [0.6, 0.45], (n, 2))
    return np.column_stack([xy, np.ones(n)]) * rng.uniform(0.3, 30, (n, 1))


def pixels_in_view() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25))
    return np.column_stack([u.ravel(), v.ravel()])


@CAMERAS
def test_projection_is_opencvs(camera: Camera) -> None:
    points = points_in_view()
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion
    )
    np.testing.assert_allclose(camera.project(points), expected.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("camera", [THESIS_CAMERA, Camera()])
def test_projection_is_gtsams(camera: Camera) -> None:
    lens = gtsam.Cal3DS2(
        camera.fx_px, camera.fy_px, 0, camera.cx_px, camera.cy_px,
        camera.k1, camera.k2, camera.p1, camera.p2,
    )  # fmt: skip
    whole = gtsam.PinholeCameraCal3DS2(gtsam.Pose3(), lens)
    points = points_in_view(50)
    np.testing.assert_allclose(
        camera.project(points), [whole.project(p) for p in points], atol=1e-9
    )
    xy = points[:, :2] / points[:, 2:]
    np.testing.assert_allclose(camera.distort(xy), [lens.uncalibrate(p) for p in xy], atol=1e-9)


@CAMERAS
def test_undistortion_undoes_distortion_over_the_whole_picture(camera: Camera) -> None:
    pixels = pixels_in_view()
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-6)


@CAMERAS
def test_undistortion_is_opencvs(camera: Camera) -> None:
    pixels = pixels_in_view()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    undistorted = cv2.undistortPointsIter(
        pixels.reshape(-1, 1, 2), camera.matrix, camera.distortion, np.eye(3), camera.matrix,
        criteria,
    ).reshape(-1, 2)  # fmt: skip
    np.testing.assert_allclose(camera.undistort_to_pinhole(pixels), undistorted, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-0.2, 0.2), st.floats(-0.1, 0.1), st.floats(-0.005, 0.005), st.floats(-0.5, 0.5),
    st.floats(-0.4, 0.4),
)  # fmt: skip
def test_mild_lenses_are_undone(k1: float, k2: float, p1: float, x: float, y: float) -> None:
    camera = Camera(k1=k1, k2=k2, p1=p1, p2=-p1)
    np.testing.assert_allclose(camera.undistort(camera.distort([[x, y]])), [[x, y]], atol=1e-8)


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels = THESIS_CAMERA.project([[0.0, 0.0, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], [THESIS_CAMERA.cx_px, THESIS_CAMERA.cy_px])


def test_no_pixels_give_no_directions() -> None:
    assert THESIS_CAMERA.undistort(np.empty((0, 2))).shape == (0, 2)


def test_a_camera_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(GOOD)
    camera = load_camera(path)
    assert (camera.fy_px, camera.k1, camera.k2, camera.readout_s) == (501.0, 0.1, 0.0, 0.0)
    path.write_text(FISHEYES)
    camera = load_camera(path)
    assert (camera.model, camera.k1, camera.k2, camera.k4) == ("fisheye", -0.02, 0.0, 0.001)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (("fx_px = 500.0", "fx_px = nan"), "fx_px"),
        (("k1 = 0.1", "k1 = inf"), "k1"),
        (("fx_px = 500.0", ""), "fx_px"),
        (("cx_px = 319.5\n", ""), "cx_px"),
        (("fx_px = 500.0", "fx_px = -500.0"), "fx_px"),
        (("width_px = 640", "width_px = 640.0"), "width_px"),
        (("width_px = 640", "width_px = 1"), "width_px"),
        (("k1 = 0.1", "k7 = 0.1"), "k7"),
        (("k1 = 0.1", "k1 = true"), "k1"),
        (("k1 = 0.1", "k1 = '0.1'"), "k1"),
        (("k1 = 0.1", "model = 'fish-eye'"), "fish-eye"),
        (("k1 = 0.1", "k4 = 0.0"), "k4 is of model = 'fisheye'"),
        (("k1 = 0.1", "readout_s = 20"), "readout_s"),
        (("k1 = 0.1", "k1 = "), "TOML"),
        (("k4 = 0.001", "p1 = 0.0"), "p1 is of model = 'opencv5'.*remove p1, or change model"),
        (("k4 = 0.001", "p2 = 0.1"), "p2 is of model = 'opencv5'"),
        (("k4 = 0.001", "k5 = 0.1"), "unknown key 'k5'"),
        (("k4 = 0.001", "k4 = nan"), "k4"),
        (("fisheye", "opencv5"), "k4 is of model = 'fisheye'.*remove k4, or change model"),
        (('model = "fisheye"\n', ""), "k4 is of model = 'fisheye'"),
        (("k1 = -0.02", "k1 = -1.5"), "turn the picture back 27° from the axis.*model = 'opencv5'"),
    ],
)
def test_a_wrong_camera_file_is_refused_in_one_line_that_names_the_key(
    tmp_path: Path, change: tuple[str, str], names: str
) -> None:
    path = tmp_path / "camera.toml"
    whole = GOOD if change[0] in GOOD else FISHEYES
    assert change[0] in whole
    path.write_text(whole.replace(*change))
    with pytest.raises(CameraError, match=names) as error:
        load_camera(path)
    text = str(error.value)
    assert str(path) in text and "\n" not in text


def test_a_missing_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"nowhere\.toml: No such file"):
        load_camera(tmp_path / "nowhere.toml")


def test_a_camera_in_memory_refuses_nan() -> None:
    with pytest.raises(CameraError, match="k2"):
        Camera(k2=float("nan"))
