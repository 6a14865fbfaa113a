"""What a map holds, as plain values."""

from __future__ import annotations

from typing import Any

from ground_station.mapping.refinement.refined import Refined
from ground_station.mapping.store import Map


def describe(map_: Map) -> dict[str, Any]:
    """What `info` says, as plain values."""
    info, lm, kf = map_.info, map_.landmarks, map_.keyframes
    camera, built = info.camera, info.built
    folder = map_.folder
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) if folder else 0
    registration, flights = info.registration, Refined.of(map_).flights
    return {
        "name": info.name,
        "frame": info.frame,
        "units": info.units,
        "images": len(kf),
        "images_given": built.get("images", len(kf)),
        "model_sizes": built.get("model_sizes", [len(kf)]),
        "landmarks": len(lm),
        "mean_track": round(float(lm.observations.mean()), 2) if len(lm) else 0.0,
        "reprojection_px": round(float(built.get("reprojection_px", float("nan"))), 3),
        "features": info.features,
        "features_sha256": info.features_sha256,
        "camera": (
            f"{camera.model} {camera.width_px}x{camera.height_px} "
            f"f {camera.fx_px:.2f} {camera.fy_px:.2f} c {camera.cx_px:.2f} {camera.cy_px:.2f}"
        ),
        "registration": registration.get("method", "none"),
        "residual_rms_m": registration.get("residual_rms_m"),
        "held_out_rms_m": registration.get("held_out_rms_m"),
        "refined": [f"{flight['name']} ({flight['frames']} frames)" for flight in flights],
        "seed": built.get("settings", {}).get("seed"),
        "stage_s": built.get("stage_s", {}),
        "size_mb": round(size / 1e6, 2),
    }
