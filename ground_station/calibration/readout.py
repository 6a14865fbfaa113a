"""How long a rolling shutter takes from first row to last, from a board that moves in the picture.

Each row is exposed at its own time, so a corner is seen from where the camera was then. Over a few
frames in a row the motion is a polynomial through their poses (as many free poses as frames, so no
frame's pose is smoothed), every corner is projected at its row's time, and all poses and the one
readout time are adjusted together. The method is that of Oth, Furgale, Kneip and Siegwart,
"Rolling Shutter Camera Calibration" (CVPR 2013), with Lagrange's polynomials in place of splines;
rows at the times of an interpolated motion are Hedborg et al.'s (CVPR 2012).

A sideways shift is near to a tilt of the board, which explains it as well: only perspective tells
them apart. So the standard deviation is that with all poses eliminated, and it says whether the
motion determines the readout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64
from ground_station.calibration import lens
from ground_station.calibration.lens import Points
from ground_station.calibration.views import View, lagrange

FRAMES = 4
"""Of one window. With four, the errors of a cubic's velocity at its frames cancel each other."""
MAX_WINDOWS = 80
_MAX_GAP_S = 0.1
_MIN_CORNERS = 12
_MIN_SPEED_PX_S = 20.0
_SLOW_SHARE = 1 / 3
"""Windows slower than this share of the fastest tell little and pull the readout low: hands tremble
faster than frames show, so that the velocity is another than the polynomial's. Of three simulated
films by hand, 20 ms came out as 19.1 to 19.5 ms with them, as 19.6 to 19.8 without."""
_STEPS, _HUBER = 12, 2.0
_DETERMINED_SHARE, _DETERMINED_S = 0.03, 3e-4
"""A third of what a readout may be off, and what a shutter without one may seem to have."""


@dataclass(frozen=True)
class Readout:
    """The time from first row to last, its standard deviation, and what it was taken from."""

    readout_s: float
    sigma_s: float
    windows: int
    rms_px: float

    @property
    def determined(self) -> bool:
        """Whether the motion tells it to 3 %, or to 0.3 ms where there is next to none."""
        return self.sigma_s <= max(_DETERMINED_SHARE * abs(self.readout_s), _DETERMINED_S)

    @property
    def backwards(self) -> bool:
        """Whether rows are read from the last to the first: the pictures were turned by half."""
        return self.readout_s < -3 * self.sigma_s - _DETERMINED_S


@dataclass
class _Window:
    """Frames in a row: board points, pixels, frame times (after the second frame), poses."""

    points_m: F64
    px: F64
    row: F64
    frame_s: F64
    nodes_s: F64
    R0: F64
    turn: F64
    shift_m: F64


def readout_of(views: Sequence[View], theta: F64, height_px: int) -> Readout | None:
    """The readout time by the views in motion; None where no frames in a row are in motion.

    `views` are sorted by input and time, `theta` (D,) is the lens.
    """
    windows = [_window(part, theta, height_px) for part in _moving(views)]
    whole = [window for window in windows if window is not None]
    if not whole:
        return None
    readout_s = 0.0
    scale = math.inf
    for _ in range(_STEPS):
        parts = [_linearise(window, theta, readout_s) for window in whole]
        scale = 1.4826 * float(np.median(np.abs(np.concatenate([part[0] for part in parts]))))
        scale = max(scale, 0.02)
        solved = [_eliminate(part, scale) for part in parts]
        told = sum(s.told for s in solved)
        if not (told > 0 and math.isfinite(told)):
            return None
        step_s = sum(s.slope for s in solved) / told
        # Beyond a frame's distance the motion is none that was seen.
        step_s = float(np.clip(step_s, -0.03, 0.03))
        readout_s += step_s
        for window, one in zip(whole, solved, strict=True):
            change = (one.nodes - one.coupling * step_s).reshape(FRAMES, 6)
            window.turn += change[:, :3]
            window.shift_m += change[:, 3:]
        if abs(step_s) < 1e-7:
            break
    if not (math.isfinite(readout_s) and abs(readout_s) < 1):
        return None
    slopes = np.array([s.slope for s in solved])
    sigma_s = max(math.sqrt(1 / told), math.sqrt(float(slopes @ slopes)) / told)
    flat = np.concatenate([part[0] for part in parts]).reshape(-1, 2)
    good = flat[np.linalg.norm(flat, axis=1) < 5 * scale]
    return Readout(readout_s, sigma_s, len(whole), lens.rms(good))


def _moving(views: Sequence[View]) -> list[list[View]]:
    """Frames in a row, those with the fastest boards, without overlap."""
    found: list[tuple[float, float, int]] = []
    for k in range(len(views) - FRAMES + 1):
        part = views[k : k + FRAMES]
        gaps = np.diff([view.seen.time_ns for view in part]) / 1e9
        if (
            len({view.seen.source for view in part}) == 1
            and all(view.velocity_px_s is not None for view in part[1:-1])
            and min(len(view.seen.ids) for view in part) >= _MIN_CORNERS
            and gaps.min() > 0
            and gaps.max() <= _MAX_GAP_S
            and gaps.max() < 2.5 * gaps.min()
        ):
            speed = min(view.speed_px_s for view in part[1:-1])
            if speed >= _MIN_SPEED_PX_S:
                # What a window tells grows with the skew's square over the corners' variance.
                worth = speed / np.mean([view.seen.edge_px for view in part])
                found.append((float(worth), speed, k))
    slow = _SLOW_SHARE * max((speed for _, speed, _ in found), default=0.0)
    found.sort(reverse=True)
    taken = np.zeros(len(views), bool)
    parts = []
    for _, speed, k in found:
        if speed >= slow and not taken[k : k + FRAMES].any():
            taken[k : k + FRAMES] = True
            parts.append(list(views[k : k + FRAMES]))
        if len(parts) == MAX_WINDOWS:
            break
    return parts


def _window(part: Sequence[View], theta: F64, height_px: int) -> _Window | None:
    poses = [lens.locate(theta, Points(v.points_m, v.seen.px, 1.0)) for v in part]
    found = [pose for pose in poses if pose is not None]
    if len(found) < FRAMES:
        return None
    nodes_s = np.array([(v.seen.time_ns - part[1].seen.time_ns) / 1e9 for v in part])
    turns = Rotation.from_rotvec([pose[:3] for pose in found])
    R0 = turns[1].as_matrix()
    counts = [len(v.seen.ids) for v in part]
    px = np.concatenate([v.seen.px for v in part])
    return _Window(
        points_m=np.concatenate([v.points_m for v in part]),
        px=px,
        row=px[:, 1] / (height_px - 1) - 0.5,
        frame_s=np.repeat(nodes_s, counts),
        nodes_s=nodes_s,
        R0=R0,
        turn=(turns * turns[1].inv()).as_rotvec(),
        shift_m=np.array([pose[3:] for pose in found]),
    )


def _cross(v: F64) -> F64:
    """The matrices [v]× (N, 3, 3) of (N, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)


def _left_jacobian(v: F64) -> F64:
    """SO(3)'s left Jacobians (N, 3, 3) of rotation vectors (N, 3). Barfoot 2017, eq. 7.77."""
    angle = np.linalg.norm(v, axis=1)
    small = angle < 1e-4
    a = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(a)) / a**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (a - np.sin(a)) / a**3)
    X = _cross(v)
    return np.asarray(np.eye(3) + first[:, None, None] * X + second[:, None, None] * (X @ X))


def _linearise(w: _Window, theta: F64, readout_s: float) -> tuple[F64, F64, F64]:
    """Residuals (2N,), their derivatives by the nodes (2N, 6·FRAMES) and by the readout (2N,)."""
    times_s = w.frame_s + w.row * readout_s
    L, dL = lagrange(w.nodes_s, times_s)
    turn, shift = L @ w.turn, L @ w.shift_m
    turned = Rotation.from_rotvec(turn).apply(w.points_m @ w.R0.T)
    in_camera = turned + shift
    px, by_camera, _ = lens.project(theta, np.zeros(6), in_camera)
    A = by_camera[:, 3:].reshape(-1, 2, 3)  # at no rotation, a shift moves every point alike
    by_turn = A @ -_cross(turned) @ _left_jacobian(turn)
    by_pose = np.concatenate([by_turn, A], axis=2)  # (N, 2, 6)
    by_nodes = (by_pose[:, :, None, :] * L[:, None, :, None]).reshape(len(L) * 2, -1)
    rate = np.concatenate([dL @ w.turn, dL @ w.shift_m], axis=1) * w.row[:, None]
    by_readout = np.einsum("nij,nj->ni", by_pose, rate).ravel()
    return (w.px - px).ravel(), by_nodes, by_readout


@dataclass
class _Solved:
    """A window without its poses: information and slope of the readout; how the nodes follow."""

    told: float
    slope: float
    nodes: F64
    coupling: F64


def _eliminate(part: tuple[F64, F64, F64], scale: float) -> _Solved:
    r, J, h = part
    norm = np.repeat(np.linalg.norm(r.reshape(-1, 2), axis=1), 2) / scale
    weight = np.where(norm <= _HUBER, 1.0, _HUBER / np.maximum(norm, 1e-9)) / scale**2
    weight[norm > 6] = 0
    WJ = weight[:, None] * J
    U = J.T @ WJ
    U += 1e-10 * np.diag(np.diag(U))
    both = np.linalg.lstsq(U, np.column_stack([WJ.T @ r, WJ.T @ h]), rcond=1e-13)[0]
    nodes, coupling = both[:, 0], both[:, 1]
    told = float((weight * h) @ h - (WJ.T @ h) @ coupling)
    slope = float((weight * h) @ r - (WJ.T @ h) @ nodes)
    return _Solved(told, slope, np.asarray(nodes, float), np.asarray(coupling, float))
