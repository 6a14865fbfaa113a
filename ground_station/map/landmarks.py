"""Landmarks from a model: filters, mean descriptors, viewing cones, covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ground_station.arrays import F32, F64, I64
from ground_station.geometry import poses
from ground_station.map.model import Model
from ground_station.map.store import Landmarks


def residuals_px(model: Model) -> F64:
    """Reprojection residuals of all observations (O, 2), pixels of the picture; inf when behind."""
    X = in_cameras(model)
    fx, fy, cx, cy = model.pinhole
    with np.errstate(divide="ignore", invalid="ignore"):
        projected = X[:, :2] / X[:, 2:] * [fx, fy] + [cx, cy]
    stretch = model.camera.stretch(model.pixel_px)[:, None]
    return np.where(X[:, 2:] > 0, (model.pixel_px - projected) / stretch, np.inf)


def in_cameras(model: Model) -> F64:
    """The points of all observations (O, 3), each in the axes of the camera that made it."""
    return poses.in_each(model.wTc[model.image], model.position[model.point])


def largest_angles_deg(model: Model) -> F64:
    """Each point's largest angle between two of its observations (M,), degrees."""
    rays = model.wTc[model.image, :3, 3] - model.position[model.point]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    order = np.argsort(model.point, kind="stable")
    starts = np.searchsorted(model.point[order], np.arange(len(model.position) + 1))
    angles = np.zeros(len(model.position))
    for m in range(len(angles)):
        observations = rays[order[starts[m] : starts[m + 1]]]
        if len(observations) > 1:
            angles[m] = np.degrees(
                np.arccos(np.clip((observations @ observations.T).min(), -1.0, 1.0))
            )
    return angles


def sigma_px(model: Model, assumed: F64 | None = None) -> float:
    """The standard deviation of a pixel coordinate, from the residuals.

    Residual sum of squares over the degrees of freedom that poses and points leave. Where
    deviations (O,) are `assumed` of the observations, what it is of these.
    """
    r = residuals_px(model)
    if assumed is not None:
        r = r / assumed[:, None]
    freedom = 2 * len(r) - 3 * len(model.position) - 6 * len(model.names) + 7
    return float(np.sqrt(np.sum(r * r) / max(freedom, 1)))


def covariances(model: Model, sigma: float | F64) -> F64:
    """Position covariances of the points (M, 3, 3) in the model's units squared.

    (Σ Jᵀ J / σ²)⁻¹ over a point's observations, J the derivative of the pixel by the position and σ
    one for all or one for each (O,); the poses count as known, so this is the landmark's own part
    of the uncertainty only.
    """
    X = in_cameras(model)
    fx, fy = model.pinhole[:2]
    z = np.maximum(X[:, 2], 1e-9)
    J = np.zeros((len(X), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = fx / z, -fx * X[:, 0] / z**2
    J[:, 1, 1], J[:, 1, 2] = fy / z, -fy * X[:, 1] / z**2
    J = J @ np.swapaxes(model.wTc[model.image, :3, :3], 1, 2)
    J /= (sigma * model.camera.stretch(model.pixel_px))[:, None, None]
    information = np.zeros((len(model.position), 3, 3))
    np.add.at(information, model.point, np.einsum("oki,okj->oij", J, J))
    return np.asarray(np.linalg.inv(information), np.float64)


def make_landmarks(model: Model, descriptors: F32) -> Landmarks:
    """Landmarks of a filtered model; `descriptors` (O, D), one for each observation.

    A landmark's descriptor is the mean of its observations' descriptors, renormalised.
    """
    return landmarks_of_blocks(model, [(np.arange(len(model.point)), descriptors)])


def landmarks_of_blocks(model: Model, blocks: Sequence[tuple[I64, F32]]) -> Landmarks:
    """As `make_landmarks`, of descriptors that need not be in memory together.

    Each block is some observations, by index (B,), with their descriptors (B, D); every observation
    is in one of them. They are gone through twice, one after the other.
    """
    count = len(model.position)
    n = np.bincount(model.point, minlength=count)
    weight = 1.0 / np.maximum(n, 1)
    mean = np.zeros((count, blocks[0][1].shape[1] if len(blocks) else 0), np.float32)
    for observations, descriptors in blocks:
        np.add.at(mean, model.point[observations], descriptors)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    square = np.zeros(len(model.point), np.float32)
    for observations, descriptors in blocks:
        square[observations] = np.sum((descriptors - mean[model.point[observations]]) ** 2, axis=1)
    spread = np.sqrt(np.bincount(model.point, square, count) * weight)
    rays = model.wTc[model.image, :3, 3] - model.position[model.point]
    distance = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(distance[:, None], 1e-12)
    direction = np.zeros((count, 3))
    np.add.at(direction, model.point, rays)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    view_cos = np.ones(count)
    np.minimum.at(view_cos, model.point, np.sum(rays * direction[model.point], axis=1))
    near, far = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(near, model.point, distance)
    np.maximum.at(far, model.point, distance)
    return Landmarks(
        id=model.point_id,
        position_m=model.position,
        covariance_m2=covariances(model, sigma_px(model)).astype(np.float32),
        descriptor=mean.astype(np.float32),
        spread=spread.astype(np.float32),
        view_direction=direction.astype(np.float32),
        view_cos=view_cos.astype(np.float32),
        distance_m=np.stack([near, far], axis=1).astype(np.float32),
        observations=n.astype(np.int32),
    )


def seen_again(lm: Landmarks, landmark: I64, position: F64) -> Landmarks:
    """The landmarks after O further observations: of `landmark` (O,), from camera positions (O, 3).

    Cones and distances hold the old observations and the new ones, and the observations are
    counted; positions, covariances and descriptors stay. The old observations themselves are not
    needed."""
    shown, group = np.unique(landmark, return_inverse=True)
    group, count = group.ravel(), len(shown)
    rays = position - lm.position_m[landmark]
    distance = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(distance[:, None], 1e-12)
    before = lm.view_direction[shown].astype(np.float64)
    direction = before * lm.observations[shown, None]
    np.add.at(direction, group, rays)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = np.where(length > 1e-9, direction / np.maximum(length, 1e-12), before)
    # A cone about the new direction holds the old one turned by what the direction turned.
    turned = np.arccos(np.clip(np.sum(direction * before, axis=1), -1, 1))
    half = np.arccos(np.clip(lm.view_cos[shown].astype(np.float64), -1, 1)) + turned
    aside = np.arccos(np.clip(np.sum(rays * direction[group], axis=1), -1, 1))
    np.maximum.at(half, group, aside)
    near, far = lm.distance_m[shown].astype(np.float64).T.copy()
    np.minimum.at(near, group, distance)
    np.maximum.at(far, group, distance)
    view_direction, view_cos = lm.view_direction.copy(), lm.view_cos.copy()
    distance_m, observations = lm.distance_m.copy(), lm.observations.copy()
    view_direction[shown] = direction
    view_cos[shown] = np.cos(np.minimum(half, np.pi))
    distance_m[shown] = np.stack([near, far], axis=1)
    observations[shown] += np.bincount(group, minlength=count).astype(np.int32)
    return replace(
        lm,
        view_direction=view_direction,
        view_cos=view_cos,
        distance_m=distance_m,
        observations=observations,
    )
