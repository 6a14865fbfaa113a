"""Pose and velocity of one frame of a rolling shutter, from a prediction and what it sees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.kinematics import (
    Kinematics,
    LandmarkObservations,
    Solution,
    no_solution,
)
from ground_station.localization.pose_newton import (
    Linear,
    Prior,
    Reprojection,
    View,
    descend,
    solve2,
)
from ground_station.localization.settings import PoseSettings

_WIDENING = 9.0
"""Squared: an observation may miss by three deviations of its landmark beside `inlier_px`."""

_MEDIAN_OF_TWO = 1.17741
"""The median length of two standard normal numbers (Rayleigh's distribution)."""

_LEAST_MISS = 0.02
"""For residuals of all but nothing: no feature is found to a few hundredths of a pixel."""

_FAR = 5.0
"""Deviations, as the inliers show theirs, beyond which none of them is right: where most fit to
half a pixel, one that misses by three would still pull as those do.

Frames described at 7.5 Hz, simulated, in a map of 100 images: 0.33, 0.34, 0.38, 0.38 and 0.40 cm in
the mean without, 0.27, 0.29, 0.33, 0.30 and 0.33 with it (plain; people; moved furniture; flicker;
a camera's processing; each frame alone 0.32 to 0.36); of 15 others between 11 % more and 10 % less,
the real ones by 1 %.
"""

_NOISE_OF_MISS = 2.0
"""Variance that moves a pose over that of what its inliers miss by: what neighbours miss by alike,
the pose takes up, and nothing of it is left to see.

Of 16 runs of simulated flights in four buildings (sharp, at 4 m/s, blurred by 2 to 4 px, at 150 to
300 kbit/s), those in which the map's own errors are the lesser part, 1.4 to 7.7, the median 3.9,
where 300 points are followed: two to three in each part of the picture. Half of it is left to
`judge.crowded`, as it grows with them.
"""

_SMALLEST = 1e-9
"""A predicted standard deviation (rad, m, rad/s, m/s) below this counts as this."""


def solve_rolling(
    predicted: Kinematics,
    observations: LandmarkObservations,
    camera: Camera,
    settings: PoseSettings,
) -> Solution:
    """The pose and twist at the frame's time that best explain its observations and the prediction.

    The maximum a posteriori of the prediction's Gaussian (its pose, twist and 12×12 covariance) and
    N observations, each seen from wTc·exp(twist·row_s): constant velocity during the readout, as in
    Hedborg et al. (CVPR 2012). A residual is whitened by its pixel noise and its landmark's
    covariance, and Huber's loss with `settings.huber_k` is that of a graph with a variable for each
    landmark. With `settings.reject_outliers` it is solved once more from the inliers alone:
    observations that miss by less than `settings.inlier_px`, widened by their landmarks'
    covariance. There both their noise and Huber's reach follow what they miss by, and those that
    miss by far more are left out, too. Of `settings`, `max_iterations` and `min_inliers` are used
    besides.

    Never raises: bad or too few observations, a covariance that is none and no convergence are a
    `Solution` without a state, with the reason.
    """
    count = len(observations)
    if reason := _refused(predicted, observations):
        return no_solution(count, reason)
    prior = _prior(predicted)
    if prior is None:
        return no_solution(count, "the prediction's covariance is not positive definite")
    every = Reprojection.of(observations, camera, settings.huber_k)
    chosen, inlier, iterations, noise = every, np.ones(count, bool), 0, 1.0
    wTc, twist = np.asarray(predicted.wTc, np.float64), np.asarray(predicted.twist, np.float64)
    with np.errstate(all="ignore"):  # what is not finite is a reason below
        for last in (False, True) if settings.reject_outliers else (True,):
            if (left := int(inlier.sum())) < settings.min_inliers:
                return no_solution(count, f"{left} inliers", iterations)
            chosen = every if left == count else every.where(inlier)
            found = descend(chosen, wTc, twist, prior, settings.max_iterations, rough=not last)
            iterations += found.iterations
            if found.reason:
                return no_solution(count, found.reason, iterations)
            wTc, twist, linear = found.wTc, found.twist, found.linear
            if chosen is every:
                spread = linear.spread_px2
            inlier_px = settings.inlier_px * observations.stretch
            view = every.view(wTc, twist)
            residual_px, inlier = _judge(view, spread, inlier_px)
            if not last and inlier.any():
                squared = _squared(
                    every.where(inlier), view.residual_px[:, inlier], spread[:, inlier]
                )
                missed = max(_LEAST_MISS, math.sqrt(float(np.median(squared))) / _MEDIAN_OF_TWO)
                inlier[inlier] = squared < (_FAR * missed) ** 2
                scale = min(1.0, missed)
                noise = _NOISE_OF_MISS * missed**2 / scale
                every = replace(
                    every,
                    variance_px2=every.variance_px2 * scale,
                    huber_k=settings.huber_k * math.sqrt(scale),
                )
    covariance = _inverse(prior.at(wTc, twist)[0] + linear.information)
    if covariance is None:
        return no_solution(count, "singular", iterations)
    if (left := int(inlier.sum())) < settings.min_inliers:
        return no_solution(count, f"{left} inliers", iterations)
    apart = prior.apart(wTc, twist)
    return Solution(
        Kinematics(predicted.time_ns, wTc, twist, covariance),
        linear.information,
        linear.gradient,
        residual_px / observations.stretch,
        inlier,
        float(apart @ prior.information @ apart),
        iterations,
        pose_by_focal=_pose_by_focal(linear, prior),
        noise=noise,
    )


def _refused(predicted: Kinematics, observations: LandmarkObservations) -> str:
    """Why these cannot be solved at all, or nothing."""
    for name, values in vars(observations).items():
        if not np.isfinite(values).all():
            return f"{name} is not finite"
    if not (observations.sigma_px > 0).all():
        return "sigma_px is not positive"
    for name, values in vars(predicted).items():
        if not np.isfinite(values).all():
            return f"the prediction's {name} is not finite"
    return ""


def _prior(predicted: Kinematics) -> Prior | None:
    """The prediction as information; None when its covariance is not positive definite."""
    sigma = np.sqrt(np.maximum(np.diag(predicted.covariance), _SMALLEST**2))
    # Of the correlations: a matrix without units inverts however far apart the variances are.
    correlation = predicted.covariance / sigma / sigma[:, None]
    correlation.flat[:: len(sigma) + 1] = 1 + 1e-12
    try:
        np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        return None
    information = np.linalg.inv(correlation) / sigma / sigma[:, None]
    information = 0.5 * (information + information.T)
    return Prior(poses.inverse(predicted.wTc), predicted.twist, information)


def _inverse(information: F64) -> F64 | None:
    """The covariance of an information matrix (12, 12); None when it is singular."""
    scale = 1.0 / np.sqrt(np.diag(information))
    try:
        result = np.linalg.inv(information * scale * scale[:, None]) * scale * scale[:, None]
    except np.linalg.LinAlgError:
        return None
    return 0.5 * (result + result.T) if np.isfinite(result).all() else None


def _pose_by_focal(linear: Linear, prior: Prior) -> F64 | None:
    """How the observations' own pose (6, 2) follows the focal length, the frame's and the map's;
    None where they leave it open.

    The twist is held by the prediction: of a global shutter no frame tells it.
    """
    free = linear.information.copy()
    free[6:, 6:] += prior.information[6:, 6:]
    scale = 1.0 / np.sqrt(np.diag(free))
    try:
        whitened = scale[:, None] * linear.by_focal
        follows = scale[:, None] * np.linalg.solve(free * scale * scale[:, None], whitened)
    except np.linalg.LinAlgError:
        return None
    return -follows[:6] if np.isfinite(follows).all() else None


def _squared(inliers: Reprojection, residual_px: F64, spread_px2: F64) -> F64:
    """How far inliers miss over what their noise says, squared (N,).

    Where pictures and map are better than `sigma_px`, pairs that are wrong by a pixel or two would
    count as right ones do, and they turn the pose: the median says how far right ones miss.
    """
    r = residual_px
    return np.asarray((solve2(inliers.variance_px2, spread_px2, r)[0] * r).sum(axis=0))


def _judge(view: View, spread_px2: F64, inlier_px: F64) -> tuple[F64, Bools]:
    """Distances (N,) of observations from projected landmarks, pixels; which are inliers (N,)."""
    r = view.residual_px
    share = (solve2(inlier_px**2, _WIDENING * spread_px2, r)[0] * r).sum(axis=0)
    residual_px = np.where(view.front, np.sqrt((r * r).sum(axis=0)), np.inf)
    return residual_px, view.front & (share < 1)
