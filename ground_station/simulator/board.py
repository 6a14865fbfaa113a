"""A printed board on a stand in a yard, and a camera carried about it, to calibrate the camera by.

The board is the one that `blimp calibrate board` prints on A4. x runs away from where the camera
is, which looks east at the board's front; z is up, the origin the yard's south-west corner.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.simulator.building import SceneBuilder
from ground_station.simulator.handheld import STEP_S, band_noise
from ground_station.simulator.motion import Motion, Mount
from ground_station.simulator.scene import Scene

SQUARES, SQUARE_M = (10, 7), 0.025
"""Squares across and down, and the side of one."""
_SQUARE_TEXELS = 96  # a multiple of a marker's bits, so that all bits are alike
_SIDE_M, _WALL_M = 4.0, 2.5
_CENTRE_M = (2.4, 2.0, 1.3)
_SHEET_SQUARES = (SQUARES[0] + 2, SQUARES[1] + 2)  # with a white margin
TEXTURE_SEED = 77041

_PLACES = ((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8), (0.5, 0.5), (0.35, 0.6), (0.65, 0.4))
_PLACE_OFF = 0.06
"""Where in the picture the board's middle is held, shares of its size, and how far beside."""
_FILLS = 0.55, 1.1
"""How much of the picture's width the board takes, far and near."""
_NEAREST_M = 0.15
"""No lens is held nearer: a wide one is not filled by a sheet of A4."""
_TILT_DEG, _ROLL_DEG = (12.0, 40.0), 25.0
_GRAZING_RAD = math.radians(70.0)
"""More from its front no board is seen; only a wide lens can come to that."""
_REST_S, _MOVE_S = 0.25, 0.75
_TREMBLE_M, _TREMBLE_DEG, _TREMBLE_HZ = 0.0006, 0.08, (3.0, 12.0)
"""Of a camera that is held in both hands at rest; a runner's is some five times as much."""


def build_board(texels_per_m: float) -> Scene:
    """The scene `board`: open to the sky, so that it is evenly lit."""
    b = SceneBuilder(texels_per_m)
    side = _SIDE_M
    b.rectangle([0, 0, 0], [side, 0, 0], [0, side, 0], "concrete")
    for origin, u, material in (
        ([0, side, 0], [side, 0, 0], "brick"), ([side, 0, 0], [-side, 0, 0], "plaster"),
        ([0, 0, 0], [0, side, 0], "plaster"), ([side, side, 0], [0, -side, 0], "brick"),
    ):  # fmt: skip
        b.rectangle(origin, u, [0, 0, _WALL_M], material)
    _hang(b, 0.5, 0.4, 0.005, "wood")
    width_m, height_m = (n * SQUARE_M for n in _SHEET_SQUARES)
    _hang(b, width_m, height_m, 0.0, "charuco", _SQUARE_TEXELS / SQUARE_M / texels_per_m)
    return b.scene("board", (side, side, _WALL_M), TEXTURE_SEED)


def _hang(
    b: SceneBuilder, width_m: float, height_m: float, behind_m: float, material: str,
    detail: float = 1.0,
) -> None:  # fmt: skip
    """Adds an upright rectangle about the board's middle, or so far behind it, that faces west."""
    x, y, z = _CENTRE_M
    corner = [x + behind_m, y + width_m / 2, z - height_m / 2]
    b.rectangle(corner, [0, -width_m, 0], [0, 0, height_m], material, detail=detail)


def carry_about(camera: Camera, duration_s: float, rng: np.random.Generator) -> Motion:
    """The camera carried about the board as one calibrates: it rests, then moves to the next view.

    The board comes into all of the picture, near and far, tilted to all sides. Moves have the least
    jerk (Flash and Hogan 1985), and the hands tremble.
    """
    views = math.ceil(duration_s / (_REST_S + _MOVE_S)) + 1
    seen = np.array([_view(camera, k, rng) for k in range(views)])  # poses of the board
    times = np.arange(math.ceil((duration_s + 1.0) / STEP_S)) * STEP_S - 0.5
    step, within = np.divmod(np.clip(times, 0, None), _REST_S + _MOVE_S)
    before = np.minimum(step.astype(int), views - 2)
    s = np.clip((within - _REST_S) / _MOVE_S, 0, 1)[:, None]
    s = s**3 * (10 - 15 * s + 6 * s**2)
    at = seen[before] + s * (seen[before + 1] - seen[before])
    tremble = band_noise(len(times), 6, _TREMBLE_HZ, rng)
    at[:, :3] += np.radians(_TREMBLE_DEG) * tremble[:, :3]
    at[:, 3:] += _TREMBLE_M * tremble[:, 3:]
    cTb = poses.pose(Rotation.from_rotvec(at[:, :3]).as_matrix(), at[:, 3:])
    # The board's x runs right as one looks at it, south; its y down, its z on into it.
    wTb = poses.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), _CENTRE_M)
    mount = Mount(0.0, 0.0, 0.0)
    wTo = wTb @ poses.inverse(cTb) @ poses.inverse(mount.bTc)
    angles = Rotation.from_matrix(wTo[:, :3, :3]).as_euler("ZYX")
    return Motion(times, wTo[:, :3, 3], np.unwrap(angles, axis=0), mount)


def _view(camera: Camera, number: int, rng: np.random.Generator) -> F64:
    """A pose (6,) of the board's middle in the camera: rotation vector, then place, metres."""
    share = np.array(_PLACES[number % len(_PLACES)]) + rng.uniform(-_PLACE_OFF, _PLACE_OFF, 2)
    ray = camera.rays(camera.drawn_in([share * [camera.width_px, camera.height_px]]))[0]
    filled_m = camera.fx_px * SQUARES[0] * SQUARE_M / camera.width_px
    nearest_m = max(filled_m / _FILLS[1], _NEAREST_M)
    place_m = ray / ray[2] * nearest_m * _FILLS[1] / rng.uniform(*_FILLS)
    while True:
        direction, tilt_deg = rng.uniform(0, 2 * np.pi), rng.uniform(*_TILT_DEG)
        tilt = np.radians(tilt_deg) * np.array([np.cos(direction), np.sin(direction), 0.0])
        roll = Rotation.from_euler("z", rng.uniform(-_ROLL_DEG, _ROLL_DEG), degrees=True)
        turn = Rotation.from_rotvec(tilt) * roll
        if turn.as_matrix()[:, 2] @ ray > math.cos(_GRAZING_RAD) * np.linalg.norm(ray):
            return np.concatenate([turn.as_rotvec(), place_m])
