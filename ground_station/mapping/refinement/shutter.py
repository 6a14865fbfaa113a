"""Rolling shutter: how fast a camera moved, and where a pixel would be without a readout.

A frame's pose is that of its middle row; the others are exposed earlier or later. A pixel that is
moved by what its landmark's projection moves between the two times fits the frame's one pose
(Hedborg et al., CVPR 2012, with the motion known from the trajectory).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, I64
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera


def row_times_s(v_px: npt.ArrayLike, camera: Camera) -> F64:
    """When distorted pixel rows (N,) are exposed, seconds after the middle row."""
    v = np.asarray(v_px, np.float64)
    return np.asarray((v / (camera.height_px - 1) - 0.5) * camera.readout_s)


def twists(time_ns: I64, wTc: F64, reach_s: float, gap_s: float) -> F64:
    """Body twists (N, 6), rad/s then m/s, from poses (N, 4, 4) at increasing times (N,).

    Each fits its neighbours within `reach_s` on both sides, and at least the nearest of each side
    where it is within `gap_s`, by least squares: the slope through the pose itself. NaN where a
    side has none, for a slope to one side alone lags behind.
    """
    n = len(time_ns)
    result = np.full((n, 6), np.nan)
    t_s = (time_ns - time_ns[0]) / 1e9 if n else np.empty(0)
    first = np.searchsorted(t_s, t_s - reach_s - 1e-9)
    last = np.searchsorted(t_s, t_s + reach_s + 1e-9)
    for i in range(1, n - 1):
        if max(t_s[i] - t_s[i - 1], t_s[i + 1] - t_s[i]) > max(gap_s, reach_s):
            continue
        near = np.r_[min(first[i], i - 1) : i, i + 1 : max(last[i], i + 2)]
        dt = t_s[near] - t_s[i]
        steps = np.array([poses.log(step) for step in poses.inverse(wTc[i]) @ wTc[near]])
        result[i] = dt @ steps / (dt @ dt)
    return result


def shift_px(points_c: F64, twist: F64, row_s: F64, camera: Camera) -> F64:
    """How far the readout moved N undistorted pixels (N, 2).

    `points_c` (N, 3) in the camera's axes at the frame's time, `twist` (N, 6), `row_s` (N,). Take
    it away from what was seen. Points behind the camera give NaN.
    """
    turn = Rotation.from_rotvec(twist[:, :3] * row_s[:, None])
    # Straight on during the readout: 0.2 mm off at 4 m/s and 45 degrees/s.
    moved = turn.inv().apply(points_c - twist[:, 3:] * row_s[:, None])
    focal = [camera.fx_px, camera.fy_px]
    flat = []
    for points in (moved, points_c):
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        flat.append(points[:, :2] / z[:, None] * focal)
    return np.asarray(flat[0] - flat[1])


def shifts_px(
    time_ns: I64,
    wTc: F64,
    camera: Camera,
    gap_s: float,
    image: I64,
    points_w: F64,
    pixel_px: F64,
) -> tuple[F64, int]:
    """How far the readout moved undistorted observations (O, 2), and in how many images it did.

    K images at `time_ns` (K,) and `wTc` (K, 4, 4); O observations, each of one `image` (O,), a
    point (O, 3) of the world and where it was seen, distorted (O, 2). An image's velocity is that
    of its neighbours where they are within `gap_s`; without one it moved nothing.
    """
    # Two images of one time, or inputs that overlap in time, have no velocity.
    order = np.argsort(time_ns, kind="stable")
    order = order[np.concatenate([np.diff(time_ns[order]) > 0, [True]])]
    twist = np.full((len(time_ns), 6), np.nan)
    if camera.readout_s > 0:
        twist[order] = twists(time_ns[order], wTc[order], 0.0, gap_s)
    known = np.isfinite(twist[image]).all(axis=1)
    X = poses.in_each(wTc[image[known]], points_w[known])
    row_s = row_times_s(pixel_px[known, 1], camera)
    shift = np.zeros((len(image), 2))
    shift[known] = np.nan_to_num(shift_px(X, twist[image[known]], row_s, camera))
    return shift, int(np.isfinite(twist).all(axis=1).sum())
