"""The lens from corners: right within its own deviations, and refused where views leave it open."""

import math
from dataclasses import replace

import numpy as np
import pytest
from board_views import Waypoints, carried, pose_of
from observed import BOARD, gathered, observed, off_by
from scipy.spatial.transform import Rotation

from ground_station.calibration.calibrate import Result, at_corners_px, calibrate
from ground_station.calibration.detection import BoardFinder, BoardObservation
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.selection import CORNERS
from ground_station.geometry.camera import THESIS_CAMERA, Camera

FINDER = BoardFinder(BOARD, BOARD.points_m())
STILL = replace(THESIS_CAMERA, readout_s=0.0)


def many(rng: np.random.Generator, count: int = 40, camera: Camera = STILL, **how: float):
    """Single views of a board that was carried about."""
    motion = carried(camera, BOARD, rng, count, **how)
    return observed(camera, motion, np.arange(count) * (motion.rest_s + motion.move_s) + 0.1, rng)


def solved(observations: list[BoardObservation], *, timed: bool = False) -> Result:
    return calibrate(gathered(observations), FINDER, [timed])


def refused(observations: list[BoardObservation]) -> str:
    with pytest.raises(CalibrationError) as error:
        solved(observations)
    assert "\n" not in str(error.value)
    return str(error.value)


def astray_px(camera: Camera, corner: tuple[int, int]) -> float:
    """How far from where it should be a corner's ray is seen, the camera turned as fits best."""
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), -1).reshape(-1, 2)
    rays = np.column_stack([STILL.undistort(np.vstack([grid, corner])), np.ones(64)])
    seen = camera.project(rays)
    turns = [camera.project(Rotation.from_rotvec(v).apply(rays)) - seen for v in 1e-5 * np.eye(3)]
    J = np.array(turns)[:, :-1].reshape(3, -1).T
    by = np.linalg.lstsq(J, (grid - seen[:-1]).ravel(), rcond=None)[0]
    return float(np.linalg.norm(seen[-1] + np.tensordot(by, np.array(turns)[:, -1], 1) - corner))


def test_the_lens_is_right_and_so_are_its_deviations() -> None:
    off, lens_off = [], []
    for seed in range(3):
        result = solved(many(np.random.default_rng(seed)))
        off += off_by(result, STILL)
        for name, corner in zip(CORNERS, ((0, 0), (639, 0), (0, 479), (639, 479)), strict=True):
            lens_off.append(
                astray_px(result.camera, corner) / at_corners_px(result.fit, (640, 480))[name]
            )
    assert 0.3 < np.sqrt(np.mean(np.square(lens_off))) < 2
    # 27 numbers over their deviations: a root mean square near 1 (0.5 to 1.6 in all but 1 of 1000
    # draws if they were independent), none far out.
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.7
    assert np.abs(off).max() < 4.5


def test_views_without_tilt_are_refused_by_the_covariance() -> None:
    rng = np.random.default_rng(1)
    assert "never tilted" in refused(many(rng, tilt_deg=0.5))


def test_an_empty_corner_is_named() -> None:
    w, h = STILL.width_px, STILL.height_px
    views = []
    for seen in many(np.random.default_rng(2), 45):
        keep = (seen.px[:, 0] < 0.72 * w) | (seen.px[:, 1] > 0.3 * h)
        if keep.sum() >= 12:
            views.append(replace(seen, ids=seen.ids[keep], px=seen.px[keep]))
    text = refused(views)
    assert "no corner of the board was seen in the upper right of the picture" in text
    assert "lower" not in text and "left" not in text


def test_one_view_and_alike_views_are_too_few() -> None:
    rng = np.random.default_rng(3)
    views = many(rng, 8)
    assert "at least 3" in refused(views[:2])
    same = [replace(views[0], index=k, px=views[0].px + rng.normal(0, 0.05, views[0].px.shape))
            for k in range(30)]  # fmt: skip
    assert "known to" in refused(same) or "open" in refused(same)


def test_one_distance_is_named_where_it_leaves_the_lens_open() -> None:
    middle = [
        pose_of(STILL, BOARD, (320 + dx, 240 + dy), 0.9, (tilt, 0.0))
        for dx, dy, tilt in ((0, 0, 0), (40, 10, 18), (-30, 20, -18), (10, -30, 16))
    ]
    motion = Waypoints(np.repeat(np.array(middle), 1, axis=0))
    views = observed(STILL, motion, np.arange(4) * 0.9 + 0.1, np.random.default_rng(4))
    assert "one distance" in refused(views)


def test_blurred_views_are_refused() -> None:
    views = [replace(seen, edge_px=7.31) for seen in many(np.random.default_rng(5), 10)]
    text = refused(views)
    assert "blurred" in text and "7.3" in text


def test_wrong_corners_and_a_wrong_view_do_not_count() -> None:
    rng = np.random.default_rng(6)
    views = many(rng)
    clean = solved(views)
    for k in range(0, len(views), 3):
        px = views[k].px.copy()
        px[rng.integers(len(px))] += rng.uniform(4, 12, 2)
        views[k] = replace(views[k], px=px)
    bent = views[7].px + 3 * np.sin(views[7].px / 40)
    views[7] = replace(views[7], px=bent)
    result = solved(views)
    assert result.corners[1] >= 5
    assert all(seen.seen is not views[7] for seen in result.views)
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        apart = abs(getattr(result.camera, name) - getattr(clean.camera, name))
        assert apart < 3 * clean.fit.deviations[name]


def test_a_bent_board_fits_no_lens() -> None:
    """4 mm up and down from corner to corner, taken for flat."""
    finder = BoardFinder(BOARD, BOARD.points_m() + np.array(
        [[0, 0, 0.004 * math.sin(3 * k)] for k in range(BOARD.corners)]))  # fmt: skip
    with pytest.raises(CalibrationError):
        calibrate(gathered(many(np.random.default_rng(7))), finder, [False])
