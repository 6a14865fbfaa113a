"""The rolling shutter's readout: measured where the motion tells it, not mentioned where not."""

from dataclasses import replace

import numpy as np
import pytest
from board_views import Waypoints, carried
from observed import BOARD, gathered, observed
from scipy.spatial.transform import Rotation

from ground_station.calibration.calibrate import _known_readout_s, calibrate
from ground_station.calibration.detection import BoardFinder
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.readout import readout_of
from ground_station.calibration.views import lagrange, views_of
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.simulator.board import SQUARE_M, build_board, carry_about

FINDER = BoardFinder(BOARD, BOARD.points_m())


def theta_of(camera: Camera) -> np.ndarray:
    return np.concatenate(
        [[camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px], camera.distortion]
    )


def measured(camera: Camera, times_s: np.ndarray, motion: "Waypoints | ByHand", seed: int):
    observations = observed(camera, motion, times_s, np.random.default_rng(seed))
    views = views_of(observations, FINDER.points_m, [True])
    return readout_of(views, theta_of(camera), camera.height_px)


@pytest.mark.parametrize("readout_s", [0.0, 0.008, 0.030])
def test_it_is_measured_with_its_deviation(readout_s: float) -> None:
    camera = replace(THESIS_CAMERA, readout_s=readout_s)
    motion = carried(camera, BOARD, np.random.default_rng(8), 8)
    times = np.arange(0.05, motion.duration_s - 0.05, 1 / 30)
    found = measured(camera, times, motion, 9)
    assert found is not None and found.determined
    assert found.readout_s == pytest.approx(readout_s, abs=max(0.03 * readout_s, 3e-4))
    assert abs(found.readout_s - readout_s) < 5 * found.sigma_s


def test_a_video_of_variable_rate_tells_it_as_well() -> None:
    motion = carried(THESIS_CAMERA, BOARD, np.random.default_rng(10), 8)
    rng = np.random.default_rng(11)
    gaps = rng.choice([0.025, 0.033, 0.041], 400)
    times = 0.05 + np.cumsum(gaps)
    times = times[times < motion.duration_s - 0.05]
    found = measured(THESIS_CAMERA, times, motion, 12)
    assert found is not None and found.determined
    assert found.readout_s == pytest.approx(THESIS_CAMERA.readout_s, rel=0.05)


def test_a_resting_board_tells_nothing() -> None:
    poses = carried(THESIS_CAMERA, BOARD, np.random.default_rng(13), 1).poses
    motion = Waypoints(np.repeat(poses, 5, axis=0))
    assert measured(THESIS_CAMERA, np.arange(0.1, 3, 1 / 30), motion, 14) is None


def test_little_motion_is_not_called_measured() -> None:
    """A slow sideways shift of a small, flat board looks like a tilt: the deviation says so."""
    small = {"least": 0.25, "most": 0.26}
    poses = carried(THESIS_CAMERA, BOARD, np.random.default_rng(15), 1, **small).poses
    poses = np.concatenate([poses, poses + np.array([0, 0, 0, 0.04, 0, 0])])
    motion = Waypoints(poses, rest_s=0.1, move_s=1.0)
    found = measured(THESIS_CAMERA, np.arange(0.05, 1.1, 1 / 30), motion, 16)
    assert found is None or not found.determined


def test_the_lens_of_a_moving_board_is_right_once_the_shutter_is_known() -> None:
    """It never rests: every view is skewed, and the skew is taken out."""
    motion = carried(THESIS_CAMERA, BOARD, np.random.default_rng(17), 15, rest_s=0.0, move_s=0.9)
    times = np.arange(0.05, motion.duration_s - 0.05, 1 / 30)
    observations = observed(THESIS_CAMERA, motion, times, np.random.default_rng(18))
    result = calibrate(gathered(observations), FINDER, [True])
    assert result.camera.readout_s == pytest.approx(THESIS_CAMERA.readout_s, rel=0.05)
    assert result.camera.fx_px == pytest.approx(THESIS_CAMERA.fx_px, rel=0.003)
    assert result.camera.cy_px == pytest.approx(THESIS_CAMERA.cy_px, abs=1.0)
    with pytest.raises(CalibrationError, match="known to"):  # and no lens without its times
        calibrate(gathered(observations), FINDER, [False])


class ByHand:
    """The simulator's trembling hands, as a motion of the board in the camera."""

    def __init__(self, seed: int) -> None:
        self.duration_s = 14.0
        self._motion = carry_about(THESIS_CAMERA, self.duration_s, np.random.default_rng(seed))
        sheet = next(s for s in build_board(20.0).surfaces if s.material == "charuco")
        right, down = (side / np.linalg.norm(side) for side in (sheet.u_m, -sheet.v_m))
        corner = sheet.corners()[3] + SQUARE_M * (right + down)  # within the sheet's margin
        self._wTb = poses.pose(np.stack([right, down, np.cross(right, down)], axis=1), corner)

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Poses (N, 6) at N times."""
        cTb = poses.inverse(self._motion.wTc(time_s)) @ self._wTb
        turns = Rotation.from_matrix(cTb[:, :3, :3]).as_rotvec()
        return np.concatenate([turns, cTb[:, :3, 3]], axis=1)


def test_hands_that_tremble_faster_than_frames_show_hardly_pull_it_low() -> None:
    off_ms = []
    for seed in (1, 2):
        motion = ByHand(seed)
        found = measured(THESIS_CAMERA, np.arange(0, motion.duration_s, 1 / 30), motion, 9)
        assert found is not None and found.determined
        off_ms.append(1e3 * (THESIS_CAMERA.readout_s - found.readout_s))
    assert np.mean(off_ms) < 0.12  # 0.18 with slow windows


def test_rows_from_last_to_first_are_said_and_not_written() -> None:
    """Pictures turned by half in software: the estimate is negative."""
    motion = carried(THESIS_CAMERA, BOARD, np.random.default_rng(19), 6)
    times = np.arange(0.05, motion.duration_s - 0.05, 1 / 30)
    found = measured(replace(THESIS_CAMERA, readout_s=-0.02), times, motion, 20)
    assert found is not None and found.determined and found.backwards
    assert found.readout_s == pytest.approx(-0.02, rel=0.05)
    notes: list[str] = []
    assert _known_readout_s(found, notes) == 0
    assert "last to the first" in notes[0]


def test_lagranges_polynomials_pass_through_their_nodes() -> None:
    nodes = np.array([-0.03, 0.0, 0.04, 0.07])
    values, slopes = lagrange(nodes, nodes)
    assert values == pytest.approx(np.eye(4), abs=1e-12)
    cubic = np.array([1.0, -2.0, 30.0, 400.0])
    at = np.array([0.01, 0.05])
    values, slopes = lagrange(nodes, at)
    sampled = np.polynomial.Polynomial(cubic)(nodes)
    assert values @ sampled == pytest.approx(np.polynomial.Polynomial(cubic)(at))
    assert slopes @ sampled == pytest.approx(np.polynomial.Polynomial(cubic).deriv()(at))
