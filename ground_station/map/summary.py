"""What a map holds, and how good it is, as plain values."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.map import landmarks
from ground_station.map.folder import sizes
from ground_station.map.levelling import levelled
from ground_station.map.model import model_of
from ground_station.map.refined import Refined
from ground_station.map.store import Map

_JUDGED = ("doubts", "parts", "left_out", "noise_px", "lens_prior", "lens")
"""What a build has written of its own doubts, as it is."""
_QUANTILES = (("p5", 5), ("p50", 50), ("p95", 95))
_COVERED_CELL = 50
"""A map's longer side has so many cells where its covered area is counted."""


def describe(map_: Map) -> dict[str, Any]:
    """What `info` says, as plain values."""
    info, lm, kf = map_.info, map_.landmarks, map_.keyframes
    camera, built = info.camera, info.built
    folder = map_.folder
    held = sizes(folder) if folder else {"total": 0}
    registration, flights = info.registration, Refined.of(map_).flights
    return {
        "name": info.name,
        "frame": info.frame,
        "units": info.units,
        "images": len(kf),
        "images_given": built.get("images", len(kf)),
        "model_sizes": built.get("model_sizes", [len(kf)]),
        **{name: built[name] for name in _JUDGED if name in built},
        "landmarks": len(lm),
        "modes": len(map_.modes) if map_.modes is not None else None,
        "mean_track": round(float(lm.observations.mean()), 2) if len(lm) else 0.0,
        "reprojection_px": round(float(built.get("reprojection_px", float("nan"))), 3),
        **{name: _quantiles(values) for name, values in figures(map_).items()},
        **_extent(map_),
        "features": info.features,
        "features_sha256": info.features_sha256,
        "camera": (
            f"{camera.model} {camera.width_px}x{camera.height_px} "
            f"f {camera.fx_px:.2f} {camera.fy_px:.2f} c {camera.cx_px:.2f} {camera.cy_px:.2f}"
        ),
        "registration": registration.get("method", "none"),
        "residual_rms_m": registration.get("residual_rms_m"),
        "held_out_rms_m": registration.get("held_out_rms_m"),
        "scale_sigma_percent": registration.get("scale_sigma_percent"),
        "refined": [f"{flight['name']} ({flight['frames']} frames)" for flight in flights],
        "seed": built.get("settings", {}).get("seed"),
        "stage_s": built.get("stage_s", {}),
        "bytes": held,
        "size_mb": round(held["total"] / 1e6, 2),
    }


def figures(map_: Map) -> dict[str, F64]:
    """What is measured of each landmark, observation or keyframe of a map, by name.

    `track`, observations of a landmark; `angle_deg`, the largest angle between two of them;
    `landmark_sigma`, the root of its covariance's trace in the map's units; `error_px`, of every
    observation, as the map stands; `in_keyframe`, the landmarks that a keyframe saw.
    """
    lm, kf = map_.landmarks, map_.keyframes
    if not len(lm) or not len(kf):
        return {}
    model = model_of(map_)
    error = np.linalg.norm(landmarks.residuals_px(model), axis=1)
    return {
        "track": lm.observations.astype(np.float64),
        "angle_deg": landmarks.largest_angles_deg(model),
        "landmark_sigma": sigma(map_),
        "error_px": error[np.isfinite(error)],
        "in_keyframe": np.diff(kf.offset).astype(np.float64),
    }


def sigma(map_: Map) -> F64:
    """The landmarks' standard deviations (M,): the root of the covariance's trace, map units."""
    trace = np.trace(map_.landmarks.covariance_m2.astype(np.float64), axis1=1, axis2=2)
    return np.asarray(np.sqrt(np.maximum(trace, 0.0)))


def _quantiles(values: F64) -> dict[str, float]:
    if not len(values):
        return {}
    return {name: float(f"{np.percentile(values, q):.4g}") for name, q in _QUANTILES}


def _extent(map_: Map) -> dict[str, Any]:
    """How long the way of its keyframes is, and what area its landmarks cover, in its units."""
    if not len(map_.landmarks) or not len(map_.keyframes):
        return {}
    upright = levelled(map_)
    path = np.linalg.norm(np.diff(upright.keyframes.wTc[:, :3, 3], axis=0), axis=1).sum()
    position = upright.landmarks.position_m
    low, high = np.percentile(position, (1, 99), axis=0)
    cell = max(float((high - low)[:2].max()) / _COVERED_CELL, 1e-9)
    inside = ((position >= low) & (position <= high)).all(axis=1)
    cells = np.unique(np.floor((position[inside, :2] - low[:2]) / cell), axis=0)
    return {
        "extent": [float(f"{length:.4g}") for length in high - low],
        "covered_area": float(f"{len(cells) * cell**2:.4g}"),
        "keyframes_path": float(f"{path:.4g}"),
    }
