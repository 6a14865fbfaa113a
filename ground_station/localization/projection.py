"""Which landmarks a camera at a pose would see, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Bools, Indices
from ground_station.geometry import poses
from ground_station.geometry.lens import NEAREST_M, Lens
from ground_station.localization.settings import ProjectionSettings
from ground_station.map.store import Landmarks


@dataclass(frozen=True)
class Projected:
    """N landmarks in view: `landmark` (N,) indices; without lens, where they are seen on the plane
    z = 1, `normalized` (N, 2), and in pixels, `pinhole_px` (N, 2)."""

    landmark: Indices
    normalized: F64
    pinhole_px: F64


def project(
    landmarks: Landmarks,
    wTc: npt.ArrayLike,
    lens: Lens,
    settings: ProjectionSettings,
    among: Indices | None = None,
) -> Projected:
    """The landmarks that a camera at `wTc` (4, 4) would see.

    Those behind the camera or outside of its (distorted) image are dropped and, if the settings say
    so, those looked at from outside of their viewing cone (Alcantarilla et al., ICRA 2010). Only
    landmarks `among` (N,) are looked at, where given: those of `visibility.LandmarkIndex`.
    """
    cTw = poses.inverse(wTc)
    position_m = landmarks.position_m if among is None else landmarks.position_m[among]
    points = position_m @ cTw[:3, :3].T + cTw[:3, 3]
    front = np.flatnonzero(points[:, 2] > NEAREST_M)
    points = points[front]
    index = front if among is None else among[front]
    normalized = points[:, :2] / points[:, 2:]
    keep = lens.inside(normalized)
    index, normalized = index[keep], normalized[keep]
    if settings.viewing_cone and len(index):
        keep = _in_cone(landmarks, index, np.asarray(wTc)[:3, 3], settings)
        index, normalized = index[keep], normalized[keep]
    camera = lens.camera
    pixels = normalized * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    return Projected(index, normalized, pixels)


def _in_cone(
    landmarks: Landmarks, index: Indices, position_m: F64, settings: ProjectionSettings
) -> Bools:
    """Whether landmarks `index` (N,) are looked at from within their widened cones; (N,).

    `position_m` (3,) is the camera's, in the world. The distances that keyframes had count, too.
    """
    rays = position_m - landmarks.position_m[index]
    distance = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
    cosine = np.einsum("ij,ij->i", rays, landmarks.view_direction[index]) / distance
    half = np.arccos(np.clip(landmarks.view_cos[index], -1.0, 1.0))
    limit = np.cos(np.minimum(half + np.deg2rad(settings.cone_margin_deg), np.pi))
    ratio = settings.max_distance_ratio
    nearest, farthest = landmarks.distance_m[index].T
    return np.asarray(
        (cosine >= limit) & (distance * ratio >= nearest) & (distance <= farthest * ratio)
    )
