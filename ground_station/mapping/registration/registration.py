"""What a registration found: the similarity, how well it is known, and what map.toml says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.geometry.alignment import Alignment
from ground_station.map.uncertainty import Uncertainty
from ground_station.mapping.registration.similarity import MIN_POINTS


@dataclass(frozen=True)
class Registration:
    """A similarity and what map.toml says about it; `notes` are lines for a person.

    `frame` is what the map's coordinates become: `world`, or `sfm` where only metres are known.
    """

    fit: Alignment
    report: dict[str, Any]
    uncertainty: Uncertainty
    notes: list[str] = field(default_factory=list)
    frame: str = "world"


def rms(error: F64) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def similarity_report(fit: Alignment, scales: Sequence[float]) -> dict[str, Any]:
    """The similarity, and the jackknife deviation of its scale from those without one measurement.

    Efron and Stein, "The jackknife estimate of variance", Annals of Statistics 9, 1981.
    """
    report: dict[str, Any] = {
        "scale": float(fit.scale),
        "rotation": fit.rotation.tolist(),
        "translation_m": fit.translation.tolist(),
    }
    if len(scales) > MIN_POINTS:
        n, log_scales = len(scales), np.log(scales)
        spread = np.sum((log_scales - log_scales.mean()) ** 2)
        report["scale_jackknife_percent"] = float(100 * np.sqrt((n - 1) / n * spread))
    return report


def listed(names: Sequence[str], residual: F64, held_out: F64) -> dict[str, Any]:
    """Names, residuals and held-out residuals of the measured places, metres."""
    report: dict[str, Any] = {
        "residual_rms_m": rms(residual),
        "residual_max_m": float(np.max(residual)),
        "point_names": list(names),
        "point_residual_m": [round(float(e), 6) for e in residual],
    }
    known = held_out[np.isfinite(held_out)]
    if len(known):
        report |= {"held_out_rms_m": rms(known), "held_out_max_m": float(known.max())}
    if len(known) == len(held_out):  # without one of a few the others may leave it open
        report["point_held_out_m"] = [round(float(e), 6) for e in held_out]
        report["disagrees_most"] = names[int(np.argmax(held_out))]
    return report
