"""The same pose without landmark variables: vectorised, damped Gauss-Newton on SE(3)."""

from __future__ import annotations

import numpy as np

from ground_station.geometry.camera import Camera
from ground_station.localization.kinematics import (
    Kinematics,
    LandmarkObservations,
    Solution,
    no_solution,
)
from ground_station.localization.pose_graph import pose_alone, reprojection_px
from ground_station.localization.pose_newton import Reprojection, descend
from ground_station.localization.settings import PoseSettings


def solve_direct(
    guess: Kinematics, observations: LandmarkObservations, camera: Camera, settings: PoseSettings
) -> Solution:
    """The pose that explains N landmarks seen at undistorted pixels, from a guess of it.

    The optimum of `solve_graph`, each landmark marginalised: see `pose_newton`. With
    `reject_outliers` it is solved once more from the inliers alone.
    """
    count, points_w, pinhole_px = len(observations), observations.points_m, observations.pinhole_px
    wTc = guess.wTc
    every = Reprojection(
        points_m=np.array(points_w.T, np.float64),
        offset_px=np.array((pinhole_px - [camera.cx_px, camera.cy_px]).T, np.float64),
        covariance_m2=np.repeat(settings.landmark_sigma_m**2 * np.eye(3)[:, :, None], count, 2),
        variance_px2=np.full(count, settings.sigma_px**2),
        row_s=None,
        camera=camera,
        huber_k=settings.huber_k,
        by_focal_m=np.zeros((3, count)),
    )
    inlier, iterations, still = np.ones(count, bool), 0, np.zeros(6)
    with np.errstate(all="ignore"):  # what is not finite is a failure
        for last in (False, True) if settings.reject_outliers else (True,):
            if (left := int(inlier.sum())) < settings.min_inliers:
                return no_solution(count, f"{left} inliers", iterations)
            chosen = every if left == count else every.where(inlier)
            found = descend(chosen, wTc, still, None, settings.max_iterations, rough=not last)
            iterations += found.iterations
            if found.reason:
                return no_solution(count, found.reason, iterations)
            wTc = found.wTc
            residual = reprojection_px(camera, wTc, points_w, pinhole_px)
            inlier = residual < settings.inlier_px
    information = found.linear.information
    if not np.linalg.cond(information) < 1e14:
        return no_solution(count, "singular", iterations)
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return pose_alone(guess.time_ns, wTc, covariance, residual, settings.inlier_px, iterations)
