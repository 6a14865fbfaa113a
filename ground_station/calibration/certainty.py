"""How well a lens is known, where it matters: in pixels, at the corners of the picture."""

from __future__ import annotations

import numpy as np

from ground_station.calibration import lens
from ground_station.calibration.lens import Fit
from ground_station.calibration.selection import CORNERS

_ACROSS, _DOWN = 9, 7


def at_corners_px(fit: Fit, size_px: tuple[int, int]) -> dict[str, float]:
    """The standard deviation of where a ray is seen, by corner of the picture.

    Where a corner is beyond what is used of a fisheye, of the last ray on the way to it that is.

    Without what a turn of the whole camera would explain: it changes poses, and no place. The turn
    is the one that fits a grid over the picture best.
    """
    w, h = size_px
    u, v = np.meshgrid(np.linspace(0, w - 1, _ACROSS), np.linspace(0, h - 1, _DOWN))
    camera = fit.camera(size_px)
    points = camera.rays(camera.drawn_in(np.stack([u.ravel(), v.ravel()], axis=1)))
    _, by_pose, by_lens = lens.project(fit.theta, np.zeros(6), points)
    turn = by_pose[:, :3]
    left = by_lens - turn @ np.linalg.lstsq(turn, by_lens, rcond=None)[0]
    variance = np.einsum("ij,jk,ik->i", left, fit.covariance, left).reshape(_DOWN, _ACROSS, 2)
    deviation = np.sqrt(np.maximum(variance, 0).sum(axis=2))
    places = ((0, 0), (0, -1), (-1, 0), (-1, -1))
    return {name: float(deviation[at]) for name, at in zip(CORNERS, places, strict=True)}
