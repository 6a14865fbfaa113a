"""The study's figures, computed from arrays; nothing here opens a file or runs a localizer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64
from ground_station.geometry import poses

NEAR_M, NEAR_DEG = 0.25, 2.0
"""A pose that a blimp can be steered by, this near to the truth."""


def pose_errors(estimated: npt.ArrayLike, true: npt.ArrayLike) -> tuple[F64, F64]:
    """Distances (N,), metres, and angles (N,), degrees, between poses (N, 4, 4), unaligned.

    NaN where an estimate is NaN.
    """
    a = np.asarray(estimated, np.float64).reshape(-1, 4, 4)
    b = np.asarray(true, np.float64).reshape(-1, 4, 4)
    metres, degrees = np.full(len(a), np.nan), np.full(len(a), np.nan)
    ok = np.isfinite(a).all(axis=(1, 2))
    if ok.any():
        metres[ok] = np.linalg.norm(a[ok, :3, 3] - b[ok, :3, 3], axis=1)
        between = np.swapaxes(a[ok, :3, :3], 1, 2) @ b[ok, :3, :3]
        degrees[ok] = np.degrees(poses.rotation_angle(between))
    return metres, degrees


def largest(errors: npt.ArrayLike) -> float:
    """The largest error that is a number; NaN when none is."""
    e = np.asarray(errors, np.float64)
    e = e[np.isfinite(e)]
    return float(e.max()) if len(e) else float("nan")


@dataclass(frozen=True)
class Recovery:
    """What followed a jump. Times in seconds from the first frame of the new place.

    `recovered_s`: until TRACKING near the truth, infinite when never. `kept_s`: how long the first
    frames went on TRACKING elsewhere. `wrong`: frames that said TRACKING and were not near.
    `worst_m`, `worst_deg`: over all frames that said TRACKING, NaN when none did.
    """

    recovered_s: float
    kept_s: float
    wrong: int
    worst_m: float
    worst_deg: float


def recovery(
    seconds: npt.ArrayLike, tracking: npt.ArrayLike, metres: npt.ArrayLike, degrees: npt.ArrayLike
) -> Recovery:
    """From the frames after a jump: times (N,), whether they say TRACKING, and their errors.

    A frame that says TRACKING without a pose (NaN errors) is wrong.
    """
    t, says = np.asarray(seconds, np.float64), np.asarray(tracking, bool)
    m, deg = np.asarray(metres, np.float64), np.asarray(degrees, np.float64)
    near = (m <= NEAR_M) & (deg <= NEAR_DEG)
    good, wrong = says & near, says & ~near
    recovered_s = float(t[good.argmax()]) if good.any() else float("inf")
    kept_s = 0.0
    if wrong.any() and wrong[0]:
        end = int((~wrong).argmax()) if not wrong.all() else len(t) - 1
        kept_s = float(t[end])
    return Recovery(recovered_s, kept_s, int(wrong.sum()), largest(m[says]), largest(deg[says]))


def percentile_of(values: Sequence[float], percent: float) -> float:
    """The smallest value that `percent` of all reach or stay below; may be infinite.

    Not interpolated: between a time and never there is nothing.
    """
    if not len(values):
        return float("nan")
    ordered = np.sort(np.asarray(values, np.float64))
    rank = int(np.ceil(percent / 100 * len(ordered))) - 1
    return float(ordered[min(max(rank, 0), len(ordered) - 1)])


def without_numbers(reason: str) -> str:
    """A reason with its numbers struck out, so that alike ones can be counted."""
    return re.sub(r"\d+(\.\d+)?", "#", reason)
