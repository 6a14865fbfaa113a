"""Points from tracks that are seen from known places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.map import landmarks
from ground_station.map.model import Model
from ground_station.mapping.sfm.models import without_observations

_LEAST_CONDITION = 1e-6
"""Rays whose normal equations are worse conditioned are parallel."""


def nearest_to_rays(model: Model) -> F64:
    """Where each point's rays come nearest to each other (M, 3); NaN where they are parallel.

    The point of least squared distance from all its rays (the midpoint of two, for two).
    """
    count = len(model.point_id)
    fx, fy, cx, cy = model.pinhole
    flat = (model.pixel_px - [cx, cy]) / [fx, fy]
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    rays = np.einsum("oij,oj->oi", model.wTc[model.image, :3, :3], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    centre = model.wTc[model.image, :3, 3]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, model.point, across)
    np.add.at(b, model.point, np.einsum("oij,oj->oi", across, centre))
    size = np.linalg.eigvalsh(A)
    found = size[:, 0] > _LEAST_CONDITION * np.maximum(size[:, 2], 1e-12)
    position = np.full((count, 3), np.nan)
    position[found] = np.linalg.solve(A[found], b[found][..., None])[..., 0]
    return position


def triangulate(model: Model, gate_px: float, min_angle_deg: float) -> tuple[Model, Bools]:
    """The model with positions from its observations, and which points (M,) are well determined.

    Twice, the second time without the observations that miss the first positions by more than
    `gate_px`; well determined is what two observations agree on with a large enough angle between
    them."""
    first = replace(model, position=nearest_to_rays(model))
    inner = without_observations(first, ~_agreeing(first, gate_px))
    result = replace(model, position=nearest_to_rays(inner))
    agreeing = without_observations(result, ~_agreeing(result, gate_px))
    good = np.bincount(agreeing.point, minlength=len(result.position)) >= 2
    good &= landmarks.largest_angles_deg(agreeing) >= min_angle_deg
    return result, np.asarray(good & np.isfinite(result.position).all(axis=1))


def _agreeing(model: Model, gate_px: float) -> Bools:
    residual = np.linalg.norm(landmarks.residuals_px(model), axis=1)
    return np.asarray(residual <= gate_px)  # NaN is not
