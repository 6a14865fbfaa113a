"""The similarity to the world: its robust start, how well it is known, and what map.toml says."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ground_station.arrays import F64, Bools
from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment, align, similarities
from ground_station.map.uncertainty import Uncertainty

MIN_POINTS = 3
MIN_WIDTH = 0.01
"""Second over first extent of the points; below, a rotation about their line is free."""
_TRIPLES = 2000
GATE_DEVIATION = 2.5
"""Robust deviations from the consensus up to which a measurement belongs to it."""
_GATE_NOISE = 3.0
_ROUNDING = 1e-9
"""Of the points' extent: arithmetic alone leaves less."""


def check_spread(points: F64, what: str, least: float = MIN_WIDTH) -> None:
    """Raises `MapError` when points (N, 3 or 2) are too few or narrower than `least` times long."""
    if len(points) < MIN_POINTS:
        raise MapError(f"registration: {len(points)} {what}; at least {MIN_POINTS} are needed")
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if extent[1] < least * extent[0] or extent[0] == 0:
        raise MapError(
            f"registration: the {len(points)} {what} lie on one line or in one place "
            f"(spread {extent[0]:.3g} by {extent[1]:.3g}); one well off it is needed"
        )


def robust_similarity(
    source: F64, target: F64, noise: F64, seed: int, what: str
) -> tuple[Alignment, Bools]:
    """The similarity from source (N, 3) to target (N, 3) that most points agree with, and which.

    `noise` (N,) is the standard deviation of each source point in source units. Triples are drawn,
    or all tried where they are few; the one with the least median of squares wins (Rousseeuw 1984).
    Points within 2.5 robust deviations of it, or three times their noise, are aligned again,
    weighted, until they stay the same ones. Raises `MapError` for too few points or points on a
    line.
    """
    check_spread(target, what)
    n = len(source)
    # The half that must agree has to be more than the triple, which fits itself.
    best, best_score = _best_triple(source, target, seed, min(n - 1, max(n // 2, MIN_POINTS)))
    if best is None:
        raise MapError(f"registration: no three of the {n} {what} form a triangle")
    deviation = 1.4826 * (1 + 5 / max(n - MIN_POINTS, 1)) * best_score
    rounding = _ROUNDING * float(np.linalg.norm(np.ptp(target, axis=0)))
    # What the consensus scatters is the targets' noise: without it the least noisy carry all.
    variance = noise**2 + (max(best_score, rounding) / best.scale) ** 2
    result, inliers = best, np.zeros(n, dtype=bool)
    for _ in range(10):
        error = np.linalg.norm(result.apply(source) - target, axis=1)
        gate = np.maximum(GATE_DEVIATION * deviation, _GATE_NOISE * result.scale * noise)
        now = error <= gate + rounding
        if (now == inliers).all():
            break
        inliers = now
        check_spread(target[inliers], f"{what} that agree with each other")
        result = align(source[inliers], target[inliers], True, 1.0 / variance[inliers])
    return result, inliers


def _best_triple(source: F64, target: F64, seed: int, rank: int) -> tuple[Alignment | None, float]:
    """The similarity by three points after which the error of this `rank` is least, and that."""
    triples = np.array(_triples(len(source), seed))
    x, y = source[triples], target[triples]
    good = np.isfinite(x).all(axis=(1, 2)) & np.isfinite(y).all(axis=(1, 2))
    x, y = x[good], y[good]
    extent = np.linalg.svd(y - y.mean(axis=1, keepdims=True), compute_uv=False)
    wide = (extent[:, 1] >= MIN_WIDTH * extent[:, 0]) & (extent[:, 0] > 0)
    rotation, translation, scale, determined = similarities(x, y, np.full(3, 1 / 3))
    best, best_score = None, np.inf
    for k in np.flatnonzero(wide & determined):
        candidate = Alignment(rotation[k], translation[k], float(scale[k]))
        error = candidate.apply(source) - target
        score = float(np.partition(np.einsum("ij,ij->i", error, error), rank)[rank])
        if score < best_score:
            best, best_score = candidate, score
    return best, float(np.sqrt(best_score))


def _triples(n: int, seed: int) -> list[list[int]]:
    count = n * (n - 1) * (n - 2) // 6
    if count <= _TRIPLES:
        return [list(triple) for triple in itertools.combinations(range(n), 3)]
    rng = np.random.default_rng(seed)
    return [rng.choice(n, 3, replace=False).tolist() for _ in range(_TRIPLES)]


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
