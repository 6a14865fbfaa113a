"""Homographies of a plane seen by a camera: turned, tilted, nearer or farther, its rows sheared.

All map pixels to pixels, (3, 3) float64, centre of the top-left pixel at (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64

Rng = np.random.Generator
Size = tuple[int, int]

_FOCAL = 1.2
"""Of the view's camera, in its widths: at a tilt of 50° the horizon stays out of the picture."""


@dataclass(frozen=True)
class WarpLimits:
    """How far views may differ. Angles in degrees; scales are picture pixels a view's pixel."""

    roll_deg: float = 30.0
    any_roll: float = 0.12
    """Share of the views that are turned by any angle."""
    tilt_deg: float = 50.0
    scale: tuple[float, float] = (0.6, 1.5)
    shear: float = 0.06
    """Of a rolling shutter: the columns by which a row runs ahead of the one below it."""


def apply(matrix: npt.NDArray[np.floating], points_px: npt.NDArray[np.floating]) -> F64:
    """Points (N, 2) through a homography: (N, 2). Points on or behind the horizon become NaN."""
    homogeneous = points_px @ matrix[:, :2].T + matrix[:, 2]
    depth = np.where(homogeneous[:, 2:] > 1e-9, homogeneous[:, 2:], np.nan)
    return np.asarray(homogeneous[:, :2] / depth, np.float64)


def inside(points_px: npt.NDArray[np.floating], size: Size, margin_px: float = 0.0) -> npt.NDArray[
    np.bool_
]:  # fmt: skip
    """Which points (N,) lie in a picture of (rows, columns), `margin_px` from its edge."""
    with np.errstate(invalid="ignore"):
        high = np.array([size[1] - 1, size[0] - 1]) - margin_px
        return np.asarray(((points_px >= margin_px) & (points_px <= high)).all(axis=1))


def of_plane(
    picture: Size,
    view: Size,
    *,
    centre_px: tuple[float, float],
    scale: float,
    roll_deg: float,
    tilt_deg: float,
    tilt_axis_deg: float,
    shear: float = 0.0,
) -> F64:
    """From a view's pixels to the picture's, which hangs before the camera as a plane.

    The view's middle sees `centre_px`, `scale` pixels of the picture a pixel of the view there; the
    plane is tilted about an axis in it and the camera rolled.
    """
    rows, columns = view
    focal = _FOCAL * columns
    to_rays = np.array(
        [[1 / focal, 0, -(columns - 1) / 2 / focal], [0, 1 / focal, -(rows - 1) / 2 / focal],
         [0, 0, 1.0]]
    )  # fmt: skip
    rolling = np.array([[1, shear, -shear * (rows - 1) / 2], [0, 1, 0], [0, 0, 1.0]])
    axis = np.radians(tilt_axis_deg)
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([np.cos(axis), np.sin(axis), 0]))
    R = (tilt * Rotation.from_euler("z", roll_deg, degrees=True)).as_matrix()
    distance = focal * scale
    # The camera is `distance` from the plane along its own axis, which meets it at the centre.
    plane = np.stack([R[0], R[1], R[2]])
    eye = -distance * R[:, 2]
    # A ray d meets z = 0 at eye + t R d with t = -eye_z / (R d)_z.
    to_plane = np.stack(
        [eye[0] * plane[2] - eye[2] * plane[0], eye[1] * plane[2] - eye[2] * plane[1], plane[2]]
    )
    shift = np.array([[1, 0, centre_px[0]], [0, 1, centre_px[1]], [0, 0, 1.0]])
    matrix = shift @ to_plane @ to_rays @ rolling
    return np.asarray(matrix / matrix[2, 2])


def pair_of_views(
    rng: Rng, picture: Size, view: Size, limits: WarpLimits, strength: float = 1.0
) -> tuple[F64, F64]:
    """Two views of one part of a picture, each from its own pixels to the picture's."""
    margin = [0.25 * side for side in picture]
    centre = np.array(
        [rng.uniform(m, side - m) for m, side in zip(margin[::-1], picture[::-1], strict=True)]
    )
    low, high = np.log(limits.scale)
    common = rng.uniform(low, high)
    views = []
    for _ in range(2):
        scale = np.exp(np.clip(common + rng.normal(0, 0.28 * strength), low, high))
        roll = rng.uniform(-limits.roll_deg, limits.roll_deg) * strength
        if rng.random() < limits.any_roll * strength:
            roll = rng.uniform(-180, 180)
        jitter = rng.uniform(-0.18, 0.18, 2) * np.array(view[::-1]) * scale * strength
        x, y = (centre + jitter).tolist()
        views.append(
            of_plane(
                picture, view, centre_px=(x, y), scale=float(scale), roll_deg=float(roll),
                tilt_deg=float(limits.tilt_deg * strength * rng.random() ** 1.5),
                tilt_axis_deg=float(rng.uniform(0, 360)),
                shear=float(rng.normal(0, limits.shear / 2)),
            )
        )  # fmt: skip
    return views[0], views[1]


def around(rng: Rng, size: Size, limits: WarpLimits) -> F64:
    """From a view of the same size to the whole picture: what homographic adaptation turns by."""
    rows, columns = size
    x = (columns - 1) / 2 + rng.uniform(-0.12, 0.12) * columns
    y = (rows - 1) / 2 + rng.uniform(-0.12, 0.12) * rows
    return of_plane(
        size, size, centre_px=(x, y), scale=float(np.exp(rng.uniform(np.log(0.65), np.log(1.35)))),
        roll_deg=float(rng.uniform(-limits.roll_deg, limits.roll_deg)),
        tilt_deg=float(0.7 * limits.tilt_deg * rng.random()),
        tilt_axis_deg=float(rng.uniform(0, 360)),
    )  # fmt: skip
