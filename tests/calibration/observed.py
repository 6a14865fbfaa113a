"""BoardObservations without pictures: corners projected at their rows' times, with noise."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from board_views import Waypoints, project_rolling

from ground_station.calibration.board import Board
from ground_station.calibration.calibrate import Result
from ground_station.calibration.detection import BoardObservation, Gathered
from ground_station.geometry.camera import THESIS_CAMERA, Camera

BOARD = Board()


def observed(
    camera: Camera, motion: Waypoints, times_s: npt.ArrayLike, rng: np.random.Generator, *,
    noise_px: float = 0.08, board: Board = BOARD,
) -> list[BoardObservation]:  # fmt: skip
    """The board at those times, as a finder would give it; frames with too little left out."""
    points_m = board.points_m()
    found = []
    for index, time_s in enumerate(np.asarray(times_s)):
        px = project_rolling(camera, points_m, motion, float(time_s))
        ids = np.flatnonzero(np.isfinite(px[:, 0]))
        if len(ids) < 12 or len(np.unique(ids // (board.columns - 1))) < 2:
            continue
        px = px[ids] + rng.normal(0, noise_px, (len(ids), 2))
        H, _ = cv2.findHomography(points_m[ids, :2], px)
        time_ns = 10**18 + round(time_s * 1e9)
        found.append(BoardObservation(0, index, f"frame-{index}", time_ns, ids, px, 30.0, 1.5, H))
    return found


def off_by(result: Result, true: Camera) -> list[float]:
    """By how many of its own deviations each number of a lens is off, which is near the true one
    and fits corners of the usual noise."""
    found = result.camera
    assert found.fx_px == pytest.approx(true.fx_px, rel=0.003)
    assert found.fy_px == pytest.approx(true.fy_px, rel=0.003)
    assert math.hypot(found.cx_px - true.cx_px, found.cy_px - true.cy_px) < 1.5
    assert result.fit.rms_px == pytest.approx(0.08 * math.sqrt(2), rel=0.1)
    deviations = result.fit.deviations.items()
    return [(getattr(found, name) - getattr(true, name)) / sigma for name, sigma in deviations]


def gathered(observations: list[BoardObservation], camera: Camera = THESIS_CAMERA) -> Gathered:
    """These observations as what was seen."""
    return Gathered(len(observations), (camera.width_px, camera.height_px), observations)
