"""Pictures of the board as views of the lens: how fast it moved, how well its corners are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import KroghInterpolator

from ground_station.arrays import F64
from ground_station.calibration.detection import BoardObservation, apply_homography
from ground_station.calibration.lens import Points

MAX_GAP_S = 0.15
"""Frames further apart tell no velocity: hands move at a few hertz."""
_CORNER_PX = 0.08
"""What a corner of a sharp, still picture is off: OpenCV's refinement on noisy pictures."""
_UNKNOWN_READOUT_S = 0.02
"""How long a camera takes to read its rows out while nothing is known of it."""
_LEFT_SHARE = 0.02
"""What is left of a shutter's skew once it was taken out: lenses bend what homographies do not."""


@dataclass(frozen=True)
class View:
    """An observation with its corners' places on the board `points_m` (N, 3).

    `velocity_px_s` (N, 2) of each corner, None where neighbouring frames do not tell; `speed_px_s`
    is their median, 0 then, `doubt_px_s` how far it may be off. `corner_px` is how far a corner is
    expected to be off, standing still.
    """

    seen: BoardObservation
    points_m: F64
    velocity_px_s: F64 | None
    speed_px_s: float
    doubt_px_s: float
    corner_px: float

    @property
    def sigma_px(self) -> float:
        """How far a corner is expected to be off while the shutter is not known."""
        return math.hypot(self.corner_px, _skew_px(self.speed_px_s, _UNKNOWN_READOUT_S))

    def points(self, height_px: int, readout_s: float | None) -> Points:
        """The corners for the adjustment, as they stood when the middle row was exposed.

        `readout_s` None: not known, so they are taken as seen, and as less certain.
        """
        if readout_s is None:
            return Points(self.points_m, self.seen.px, self.sigma_px)
        px = self.seen.px
        if self.velocity_px_s is not None:
            row_s = (px[:, 1] / (height_px - 1) - 0.5) * readout_s
            px = px - self.velocity_px_s * row_s[:, None]
        left = _skew_px(self.doubt_px_s + _LEFT_SHARE * self.speed_px_s, abs(readout_s))
        return Points(self.points_m, px, math.hypot(self.corner_px, left))


def _skew_px(speed_px_s: float, readout_s: float) -> float:
    """The deviation of what rows that are spread over the readout are shifted by."""
    return speed_px_s * readout_s / math.sqrt(12)


def views_of(observations: list[BoardObservation], points_m: F64, timed: list[bool]) -> list[View]:
    """Every observation, sorted by input and time, as a view.

    `points_m` (N, 3) are the board's corners by id; `timed` says of each input whether its frames'
    times can be trusted.
    """
    found = []
    for k, seen in enumerate(observations):
        points = points_m[seen.ids]
        velocity, doubt = _velocity(observations, k, points) if timed[seen.source] else (None, 0.0)
        speed = 0.0
        if velocity is not None:
            speed = float(np.median(np.linalg.norm(velocity, axis=1)))
        corner_px = _CORNER_PX * max(1.0, seen.edge_px / 2)
        found.append(View(seen, points, velocity, speed, doubt, corner_px))
    return found


def _velocity(
    observations: list[BoardObservation], k: int, points_m: F64
) -> tuple[F64 | None, float]:
    """Of the k-th observation's corners, pixels a second, and how far that is off.

    By the parabola through three frames, or the quartic through five: what the one differs from the
    other, or the parabola from a chord, is what it may be off. Homographies put every corner into
    frames that lost it.
    """
    if not (_follows(observations, k) and _follows(observations, k + 1)):
        return None, 0.0
    slopes = [_slope(observations, k, range(k - 1, k + 2), points_m)]
    if _follows(observations, k - 1) and _follows(observations, k + 2):
        slopes.insert(0, _slope(observations, k, range(k - 2, k + 3), points_m))
    else:
        slopes.append(_slope(observations, k, range(k, k + 2), points_m))
    if not np.isfinite(slopes).all():
        return None, 0.0
    return slopes[0], float(np.median(np.linalg.norm(slopes[0] - slopes[1], axis=1)))


def _follows(observations: list[BoardObservation], k: int) -> bool:
    """Whether the k-th observation comes soon after the one before, in the same input."""
    if not 0 < k < len(observations) or observations[k - 1].source != observations[k].source:
        return False
    return 0 < observations[k].time_ns - observations[k - 1].time_ns <= MAX_GAP_S * 1e9


def _slope(observations: list[BoardObservation], k: int, near: range, points_m: F64) -> F64:
    """The derivative (N, 2) at the k-th observation of the polynomial through some around it."""
    nodes_s = np.array([(observations[j].time_ns - observations[k].time_ns) / 1e9 for j in near])
    _, slopes = lagrange(nodes_s, np.zeros(1))
    places = np.array([apply_homography(observations[j].H, points_m[:, :2]) for j in near])
    return np.asarray(np.einsum("j,jni->ni", slopes[0], places))


def lagrange(nodes_s: F64, times_s: F64) -> tuple[F64, F64]:
    """Lagrange's polynomials of M nodes at N times (N, M), and their derivatives (N, M)."""
    basis = KroghInterpolator(nodes_s, np.eye(len(nodes_s)))
    return basis(times_s), basis.derivative(times_s)
