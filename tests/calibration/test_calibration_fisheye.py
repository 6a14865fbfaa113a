"""A fisheye from corners: as right as the five parameters are, and suggested where these misfit."""

import numpy as np
import pytest
from board_views import carried
from observed import BOARD, gathered, observed, off_by
from scipy.spatial.transform import Rotation

from ground_station.calibration import lens
from ground_station.calibration.calibrate import Result, calibrate
from ground_station.calibration.detection import BoardFinder
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.results import write_camera
from ground_station.geometry.camera import Camera, load_camera

FINDER = BoardFinder(BOARD, BOARD.points_m())
FISHEYE = Camera(
    fx_px=244.4, fy_px=245.1, cx_px=317.2, cy_px=241.9,
    model="fisheye", k1=-0.021, k2=0.0043, k3=-0.0012, k4=0.0002,
)  # fmt: skip
"""150° from left to right."""


def views(seed: int, camera: Camera = FISHEYE):
    motion = carried(camera, BOARD, np.random.default_rng(seed), 40)
    times_s = np.arange(40) * (motion.rest_s + motion.move_s) + 0.1
    return gathered(observed(camera, motion, times_s, np.random.default_rng(seed)))


def solved(seed: int, model: str, camera: Camera = FISHEYE) -> Result:
    return calibrate(views(seed, camera), FINDER, [False], model=model)


def test_a_fisheye_is_right_and_so_are_its_deviations() -> None:
    off = []
    for seed in range(3):
        result = solved(seed, "fisheye")
        assert result.camera.model == "fisheye"
        off += off_by(result, FISHEYE)
        assert all(region.lens_px < 2 for region in result.regions() if region.lens_px is not None)
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.7
    assert np.abs(off).max() < 4.5


def test_five_parameters_that_misfit_name_the_fisheye() -> None:
    """As a refusal or as a note; either says what to do."""
    try:
        said = " ".join(solved(1, "opencv5").notes)
    except CalibrationError as error:
        said = str(error)
    assert "--model fisheye" in said and "\n" not in said


def test_an_ordinary_lens_is_not_taken_for_a_fisheye() -> None:
    ordinary = Camera(k1=0.1673, k2=-0.2605, p1=-1.3e-5, p2=-0.00203)
    assert not solved(2, "opencv5", ordinary).notes


def test_the_derivatives_are_those_of_the_projection() -> None:
    theta = np.array([244.4, 245.1, 317.2, 241.9, -0.021, 0.0043, -0.0012, 0.0002])
    pose = np.array([0.3, -0.2, 0.1, 0.4, -0.1, 0.35])
    points = FINDER.points_m
    px, by_pose, by_lens = lens.project(theta, pose, points)
    whole = Rotation.from_rotvec(pose[:3]).apply(points) + pose[3:]
    np.testing.assert_allclose(px, FISHEYE.project(whole), atol=1e-9)
    for J, k, of in [(by_pose, k, pose) for k in range(6)] + [
        (by_lens, k, theta) for k in range(8)
    ]:
        h = 1e-6 * max(1.0, abs(of[k]))
        ends = []
        for sign in (1, -1):
            t, p = theta.copy(), pose.copy()
            (p if of is pose else t)[k] += sign * h
            ends.append(lens.project(t, p, points)[0])
        numeric = (ends[0] - ends[1]).ravel() / (2 * h)
        np.testing.assert_allclose(J[:, k], numeric, atol=1e-4 * max(1.0, np.abs(numeric).max()))


def test_the_file_written_is_the_camera(tmp_path) -> None:
    result = solved(0, "fisheye")
    write_camera(tmp_path / "camera.toml", result, BOARD)
    text = (tmp_path / "camera.toml").read_text()
    assert "k1 k2 k3 k4" in text and "p1" not in text
    read = load_camera(tmp_path / "camera.toml")
    assert read.model == "fisheye"
    assert read.matrix == pytest.approx(result.camera.matrix, abs=1e-3)
    assert read.distortion == pytest.approx(result.camera.distortion, abs=1e-6)
