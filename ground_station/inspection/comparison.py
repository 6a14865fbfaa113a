"""Does the prediction hold: along a flown path, predicted uncertainty beside the actual error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from ground_station.arrays import F64
from ground_station.errors import InputError
from ground_station.evaluation.ate import associate
from ground_station.geometry.trajectory import Trajectory
from ground_station.inspection.prediction import Prediction, Predictor
from ground_station.map.store import Map

_MAX_DIFF_S = 0.005
_LEAST_SHARE = 0.6
"""Of the estimate's interval the truth's is at least so much."""
_SPAN_S = 1.0
"""Frames of so long a time share their view and their error: they are also judged together."""


@dataclass(frozen=True)
class Comparison:
    """N frames of a flight: where they truly were, what was predicted there, and the error.

    `error_m` (N,) is the position's; infinite where the localizer gave no pose.
    """

    truth: Trajectory
    prediction: Prediction
    error_m: F64

    def predicted(self) -> F64:
        """The position's predicted deviation (N,), m; infinite where it would be lost."""
        return np.where(self.prediction.lost, np.inf, self.prediction.sigma_m)

    def summary(self) -> dict[str, Any]:
        """Spearman's rank correlations, and how many frames they are of.

        Frames without a pose have the largest errors, all alike; places where the localizer would
        be lost the largest deviations. `of_localized` leaves both out. `per_second` compares the
        medians of each second.
        """
        predicted, error = self.predicted(), self.error_m
        both = np.isfinite(predicted) & np.isfinite(error)
        second = (self.truth.time_ns - self.truth.time_ns[0]) // int(_SPAN_S * 1e9)
        spans = [np.flatnonzero(second == s) for s in np.unique(second)]
        medians = [
            np.array([np.median(values[span]) for span in spans]) for values in (predicted, error)
        ]
        lost, would_be = ~np.isfinite(error), self.prediction.lost
        return {
            "frames": len(error),
            "localized": int(np.isfinite(error).sum()),
            "predicted_lost": int(would_be.sum()),
            "lost_and_predicted": int((lost & would_be).sum()),
            "rank_correlation": spearman(predicted, error),
            "rank_correlation_of_localized": spearman(predicted[both], error[both]),
            "rank_correlation_per_second": spearman(*medians),
            "median_error_m": float(np.median(error[~lost])) if (~lost).any() else None,
            "median_predicted_m": (
                float(np.median(predicted[~would_be])) if (~would_be).any() else None
            ),
        }


def compare(map_: Map, estimate: Trajectory, truth: Trajectory, step: int = 1) -> Comparison:
    """Every `step`-th true pose of a flight in a registered map, within the estimate's time.

    The localizer's poses (its file holds the frames that it solved) are taken at the same times.
    The truth has a pose for each frame, so that one without an estimate is a frame that was lost.
    Raises `InputError` when it has far more, and when none fits.
    """
    if not map_.info.registered:
        raise InputError(f"the map '{map_.info.name}' is not registered: its errors have no unit")
    apart_s = [_interval_s(trajectory) for trajectory in (truth, estimate)]
    if apart_s[0] < _LEAST_SHARE * apart_s[1]:
        raise InputError(
            f"the truth has a pose every {1e3 * apart_s[0]:.3g} ms, the estimate every "
            f"{1e3 * apart_s[1]:.3g} ms; one for each frame is needed"
        )
    part = truth[::step]
    i, j = associate(estimate.time_ns, part.time_ns, _MAX_DIFF_S)
    if not len(i):
        raise InputError("no estimated pose is of the time of a true one")
    error = np.full(len(part), np.inf)
    error[j] = np.linalg.norm(estimate.position_m[i] - part.position_m[j], axis=1)
    return Comparison(part, Predictor(map_).poses(part.wTc), error)


def _interval_s(trajectory: Trajectory) -> float:
    """The median time between two poses, 0 where there are not two."""
    return float(np.median(np.diff(trajectory.time_ns))) / 1e9 if len(trajectory) > 1 else 0.0


def spearman(a: F64, b: F64) -> float | None:
    """Spearman's rank correlation of two arrays (N,), equal values sharing their mean rank.

    Infinite values are the largest. None where one of them is all alike.
    """
    if len(a) < 3 or a.min() == a.max() or b.min() == b.max():
        return None
    return round(float(spearmanr(a, b).statistic), 4)
