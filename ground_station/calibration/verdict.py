"""Whether views determine the lens; if not, what is missing and what to do, in one line."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64
from ground_station.calibration import selection
from ground_station.calibration.board import Board
from ground_station.calibration.detection import BoardFinder, Gathered, other_board
from ground_station.calibration.errors import CalibrationError
from ground_station.calibration.lens import Fit
from ground_station.calibration.views import View

MAX_FOCAL_SHARE = 0.0015
"""Of the focal length, one standard deviation: two of them are the 0.3 % asked of a calibration."""
MAX_CENTRE_SHARE = 0.75 / 640
"""Of the width, of the principal point: two of them are 1.5 px at 640."""
MIN_VIEWS = 3
"""A view of a plane gives two equations for a camera's five numbers (Zhang 2000, section 3.1)."""
_TILTED_DEG = 15.0
_DISTANCES = 1.25
_MAX_RMS_SHARE = 3 / 640


def tilts_deg(poses: F64) -> F64:
    """Angle (V,) between the board and the picture's plane, of poses (V, 6)."""
    z = Rotation.from_rotvec(poses[:, :3]).as_matrix()[:, 2, 2]
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(z), 0, 1))))


def distances_m(poses: F64, middle_m: F64) -> F64:
    """Depth (V,) of the board's middle (3,)."""
    turned = Rotation.from_rotvec(poses[:, :3]).apply(middle_m)
    return np.asarray(turned[:, 2] + poses[:, 5])


def check_seen(gathered: Gathered, finder: BoardFinder) -> None:
    """Refuses frames without the board, saying what is there instead where that can be told."""
    board: Board = finder.board
    if gathered.observations or not gathered.frames:
        return
    other = other_board(board, gathered.without)
    if other:
        raise CalibrationError(other)
    most = max((finder.corners_of(image) for image in gathered.without), default=0)
    if most:
        raise CalibrationError(
            f"no frame of {gathered.frames} shows enough of the board: at most {most} of its "
            f"{board.corners} corners were made out; hold it nearer, flat and well lit"
        )
    raise CalibrationError(
        f"no frame of {gathered.frames} shows a board of {board.name}: nearer, flatter, more "
        "light, less motion, or another board's file"
    )


def check_sharp(views: Sequence[View], usable: Sequence[View]) -> None:
    """Refuses views that are all blurred, and fewer than a lens can be had of."""
    if not usable:
        best = min(view.seen.edge_px for view in views)
        raise CalibrationError(
            f"all {len(views)} views are blurred: the sharpest has edges {best:.1f} px wide, at "
            f"most {selection.MAX_EDGE_PX:g} are of use; hold still, focus, give more light"
        )
    if len(usable) < MIN_VIEWS:
        blurred = len(views) - len(usable)
        raise CalibrationError(
            f"{len(usable)} sharp view{'s' * (len(usable) != 1)} of the board ({blurred} blurred); "
            f"at least {MIN_VIEWS}, tilted each another way, and 15 to 40 are good"
        )


def check_determined(
    fit: Fit, usable: Sequence[View], size_px: tuple[int, int], middle_m: F64
) -> None:
    """Refuses a lens that its views leave open, by its covariance, and says which are missing."""
    missing = []
    focal = max(
        fit.deviations[name] / abs(value)
        for name, value in zip(("fx_px", "fy_px"), fit.theta[:2], strict=True)
    )
    centre = max(fit.deviations["cx_px"], fit.deviations["cy_px"])
    width = size_px[0]
    sane = all(0.1 * width < value < 20 * width for value in fit.theta[:2])
    if not (sane and focal <= MAX_FOCAL_SHARE and centre <= MAX_CENTRE_SHARE * width):
        missing.append(_why(fit, focal if sane else math.inf, centre, middle_m))
    empty = selection.empty_corners([view.seen for view in usable], size_px)
    if empty:
        them = "it" if len(empty) == 1 else "them"
        missing.append(
            f"no corner of the board was seen in the {' and '.join(empty)} of the picture: "
            f"hold the board into {them}"
        )
    if missing:
        raise CalibrationError("; ".join(missing))
    if fit.rms_px > _MAX_RMS_SHARE * width:
        raise CalibrationError(
            f"no lens fits these views: corners are off by {fit.rms_px:.1f} px (RMS), at most "
            f"{_MAX_RMS_SHARE * width:.1f}; is the board flat, and its file right?"
        )


def _why(fit: Fit, focal: float, centre: float, middle_m: F64) -> str:
    tilt = float(tilts_deg(fit.poses).max())
    distance = distances_m(fit.poses, middle_m)
    known = (
        f"the focal length is known to {100 * focal:.3g} % only (at most "
        f"{100 * MAX_FOCAL_SHARE:g} %) and the centre to {centre:.2g} px"
        if math.isfinite(focal)
        else "the views leave the focal length open"
    )
    if tilt < _TILTED_DEG:
        return (
            f"{known}: the board was never tilted (at most {tilt:.0f}°), so that focal length and "
            "distance cannot be told apart; tilt it by 30° and more, each time another way"
        )
    if len(fit.poses) > MIN_VIEWS and distance.max() < _DISTANCES * distance.min():
        return (
            f"{known}: all {len(fit.poses)} views are from one distance ({distance.min():.2f} to "
            f"{distance.max():.2f} m); hold the board near and far, and tilted"
        )
    return (
        f"{known}: the {len(fit.poses)} views are too few or too alike; more places, tilts and "
        "distances"
    )
