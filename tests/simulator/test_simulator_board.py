"""A camera carried about a printed board shows all that calibrating it asks for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from quick_flight import quick_settings

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA, Camera
from ground_station.simulator import board
from ground_station.simulator.plans import PHONE_CAMERA, WIDE_CAMERA
from ground_station.simulator.scene import SimulatorError
from ground_station.simulator.simulate import prepare_flight

FISHEYE = Camera(width_px=640, height_px=480, fx_px=230.0, fy_px=230.0, cx_px=319.0, cy_px=241.0,
                 model="fisheye", k1=-0.02)  # fmt: skip


def inner_corners_m() -> F64:
    """Where four squares meet (N, 3), world coordinates, metres."""
    columns, rows = board.SQUARES
    across, up = np.meshgrid(np.arange(1, columns) - columns / 2, np.arange(1, rows) - rows / 2)
    (sheet,) = (s for s in board.build_board(20.0).surfaces if s.material == "charuco")
    middle = sheet.origin_m + (sheet.u_m + sheet.v_m) / 2
    u, v = (side / np.linalg.norm(side) for side in (sheet.u_m, sheet.v_m))
    off = across.reshape(-1, 1) * u + up.reshape(-1, 1) * v
    return np.asarray(middle + board.SQUARE_M * off)


@pytest.mark.parametrize("camera", [THESIS_CAMERA, PHONE_CAMERA, WIDE_CAMERA, FISHEYE])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_board_comes_into_all_corners_near_and_far_and_tilted(
    camera: Camera, seed: int
) -> None:
    settings = quick_settings(Path("f.mcap"), scene="board", plan="board", seed=seed,
                              duration_s=None, rate_hz=None, camera=camera)  # fmt: skip
    flight = prepare_flight(settings)
    assert flight.rate_hz == 30 and flight.camera == camera
    points = inner_corners_m()
    size = np.array([camera.width_px, camera.height_px])
    corners, distances, tilts, whole = set(), [], [], 0
    for wTc in flight.motion.wTc(flight.times_s):
        seen = poses.transform(poses.inverse(wTc), points)
        px = camera.project(seen)
        inside = np.isfinite(px).all(axis=1) & (px >= 0).all(axis=1) & (px < size).all(axis=1)
        whole += inside.all()
        outer = np.where(px < 0.2 * size, 0, np.where(px > 0.8 * size, 2, 1))[inside]
        corners |= set(map(tuple, outer.tolist())) & {(0, 0), (0, 2), (2, 0), (2, 2)}
        distances.append(seen[:, 2].mean())
        tilts.append(np.degrees(np.arccos(wTc[0, 2])))  # the board faces west
    assert len(corners) == 4
    assert min(distances) > 0.1 and max(distances) > 1.5 * min(distances)
    assert max(tilts) > 25
    assert whole > 10
    speed, _ = flight.motion.speed(flight.times_s)
    assert np.median(speed) > 0.05 and np.quantile(speed, 0.1) < 0.05  # it moves, and rests


def test_the_board_and_its_plan_belong_together() -> None:
    settings = quick_settings(Path("f.mcap"), plan="board")
    with pytest.raises(SimulatorError, match="plan 'board' films a board; scene 'atrium' has none"):
        prepare_flight(settings)
    with pytest.raises(SimulatorError, match="plan 'loop' does not fit into 'board'"):
        prepare_flight(replace(settings, scene="board", plan="loop"))
