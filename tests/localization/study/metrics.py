"""The study's figures, computed from arrays; nothing here opens a file or runs a localizer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

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


def rmse(errors: npt.ArrayLike) -> float:
    """The root of the mean square of the errors that are numbers; NaN when none is."""
    e = np.asarray(errors, np.float64)
    e = e[np.isfinite(e)]
    return float(np.sqrt(np.mean(e * e))) if len(e) else float("nan")


def largest(errors: npt.ArrayLike) -> float:
    """The largest error that is a number; NaN when none is."""
    e = np.asarray(errors, np.float64)
    e = e[np.isfinite(e)]
    return float(e.max()) if len(e) else float("nan")


def longest_span_s(time_ns: npt.ArrayLike, flagged: npt.ArrayLike) -> float:
    """The longest time from a first flagged frame to the next that is not, or to the last frame.

    `time_ns` (N,), rising; `flagged` (N,). 0 when none is flagged.
    """
    t, f = np.asarray(time_ns, np.int64), np.asarray(flagged, bool)
    longest, since = 0, None
    for now, on in zip(t.tolist(), f.tolist(), strict=True):
        if since is not None:
            longest = max(longest, now - since)
        since = (now if since is None else since) if on else None
    return longest / 1e9


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


def tangent_errors(estimated: npt.ArrayLike, true: npt.ArrayLike) -> F64:
    """ξ (N, 6) of each pose, true = estimated·exp(ξ), rotation before translation."""
    a = np.asarray(estimated, np.float64).reshape(-1, 4, 4)
    b = np.asarray(true, np.float64).reshape(-1, 4, 4)
    xi = [poses.log(between) for between in poses.inverse(a) @ b]
    return np.asarray(xi, np.float64).reshape(-1, 6)


def nees(xi: npt.ArrayLike, covariance: npt.ArrayLike) -> F64:
    """ξᵀ·C⁻¹·ξ (N,) of errors (N, D) and covariances (N, D, D); infinite where C is no covariance.

    Bar-Shalom, Li and Kirubarajan, Estimation with Applications (2001), 5.4: its mean is D and it
    is χ² with D degrees of freedom where the covariance tells the truth.
    """
    e, C = np.asarray(xi, np.float64), np.asarray(covariance, np.float64)
    result = np.full(len(e), np.inf)
    for k, (error, matrix) in enumerate(zip(e, C, strict=True)):
        if np.isfinite(matrix).all() and np.linalg.eigvalsh((matrix + matrix.T) / 2)[0] > 0:
            result[k] = error @ np.linalg.solve(matrix, error)
    return result


def share_inside(values: npt.ArrayLike, degrees_of_freedom: int, level: float = 0.95) -> float:
    """The share of NEES values (N,) inside the ellipsoid that holds `level`; NaN when none."""
    v = np.asarray(values, np.float64)
    return float(np.mean(v <= chi2.ppf(level, degrees_of_freedom))) if len(v) else float("nan")


def consistency(xi: npt.ArrayLike, covariance: npt.ArrayLike) -> dict[str, object]:
    """How well covariances (N, 6, 6) tell errors (N, 6): shares, means, and each axis's ratio.

    `axis_ratio` (6,) is the RMS of error over standard deviation, 1 when that is right.
    """
    e = np.asarray(xi, np.float64).reshape(-1, 6)
    C = np.asarray(covariance, np.float64).reshape(-1, 6, 6)
    whole = nees(e, C)
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", C), 1e-30))
    return {
        "frames": len(e),
        "inside_95": share_inside(whole, 6),
        "mean_nees": float(np.mean(whole)) if len(e) else float("nan"),
        "median_nees": float(np.median(whole)) if len(e) else float("nan"),
        "rotation_inside_95": share_inside(nees(e[:, :3], C[:, :3, :3]), 3),
        "translation_inside_95": share_inside(nees(e[:, 3:], C[:, 3:, 3:]), 3),
        "axis_ratio": [rmse(e[:, k] / sigma[:, k]) for k in range(6)],
        "median_sigma_deg": float(np.degrees(np.median(sigma[:, :3]))) if len(e) else float("nan"),
        "median_sigma_m": float(np.median(sigma[:, 3:])) if len(e) else float("nan"),
    }


def without_numbers(reason: str) -> str:
    """A reason with its numbers struck out, so that alike ones can be counted."""
    return re.sub(r"\d+(\.\d+)?", "#", reason)
