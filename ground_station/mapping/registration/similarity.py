"""The similarity from a model's coordinates to the world's: robust, then refined in pixels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ground_station.errors import GeometryError, MapError
from ground_station.geometry.alignment import Alignment, align
from ground_station.geometry.camera import Camera
from ground_station.mapping.registration.sights import Triangulated

F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

MIN_POINTS = 3
_MIN_WIDTH = 0.01
"""Second over first extent of the points; below, a rotation about their line is free."""
_TRIPLES = 2000
GATE_DEVIATION = 2.5
"""Robust deviations from the consensus up to which a measurement belongs to it."""
_GATE_NOISE = 3.0
_LOSS_PX = 2.0
_ROUNDING = 1e-9
"""Of the points' extent: arithmetic alone leaves less."""


def check_spread(points: F64, what: str) -> None:
    """Raises `MapError` when points (N, 3) are too few or on one line."""
    if len(points) < MIN_POINTS:
        raise MapError(f"registration: {len(points)} {what}; at least {MIN_POINTS} are needed")
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if extent[1] < _MIN_WIDTH * extent[0] or extent[0] == 0:
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
    weights = 1.0 / np.maximum(noise, np.median(noise) / 10 + 1e-12) ** 2
    # The half that must agree has to be more than the triple, which fits itself.
    rank = min(n - 1, max(n // 2, MIN_POINTS))
    best, best_score = None, np.inf
    for triple in _triples(n, seed):
        try:
            check_spread(target[triple], what)
            candidate = align(source[triple], target[triple], True)
        except (MapError, GeometryError):
            continue
        score = float(np.sort(np.linalg.norm(candidate.apply(source) - target, axis=1))[rank])
        if score < best_score:
            best, best_score = candidate, score
    if best is None:
        raise MapError(f"registration: no three of the {n} {what} form a triangle")
    deviation = 1.4826 * (1 + 5 / max(n - MIN_POINTS, 1)) * best_score
    rounding = _ROUNDING * float(np.linalg.norm(np.ptp(target, axis=0)))
    result, inliers = best, np.zeros(n, dtype=bool)
    for _ in range(10):
        error = np.linalg.norm(result.apply(source) - target, axis=1)
        gate = np.maximum(GATE_DEVIATION * deviation, _GATE_NOISE * result.scale * noise)
        now = error <= gate + rounding
        if (now == inliers).all():
            break
        inliers = now
        check_spread(target[inliers], f"{what} that agree with each other")
        result = align(source[inliers], target[inliers], True, weights[inliers])
    return result, inliers


def _triples(n: int, seed: int) -> list[list[int]]:
    count = n * (n - 1) * (n - 2) // 6
    if count <= _TRIPLES:
        return [list(triple) for triple in itertools.combinations(range(n), 3)]
    rng = np.random.default_rng(seed)
    return [rng.choice(n, 3, replace=False).tolist() for _ in range(_TRIPLES)]


def refine_similarity(
    start: Alignment, points: Sequence[Triangulated], camera: Camera
) -> tuple[Alignment, float]:
    """The similarity that puts known points where their sights are, and the RMS left, in pixels.

    Minimises the reprojection of the world points into the model's cameras, which stay where they
    are, over rotation, translation and scale, with a soft-L1 loss: a point far away or seen under a
    small angle counts in the directions in which its sights know it. Distances between points and
    model are in the model's units, so nothing hangs on a triangulation.
    """
    world = np.concatenate([np.tile(point.world_m, (len(point.ray), 1)) for point in points])
    wTc = np.concatenate([point.wTc for point in points])
    ray = np.concatenate([point.ray for point in points])
    centre = world.mean(axis=0)
    middle = start.rotation.T @ (centre - start.translation) / start.scale

    def model_points(x: F64) -> F64:
        R = start.rotation @ Rotation.from_rotvec(x[:3]).as_matrix()
        # translation in model units about the middle of the points, scale as its logarithm
        return (world - centre) @ R / (start.scale * np.exp(x[6])) + middle + x[3:6]

    def residuals(x: F64) -> F64:
        positions = model_points(x)
        c = np.einsum("sji,sj->si", wTc[:, :3, :3], positions - wTc[:, :3, 3])
        xy = c[:, :2] / np.maximum(c[:, 2:], 1e-6)
        return np.asarray(((ray - xy) * [camera.fx_px, camera.fy_px]).ravel())

    unit = max(float(np.linalg.norm(wTc[:, :3, 3] - middle, axis=1).mean()), 1e-9)
    solved = least_squares(
        residuals,
        np.zeros(7),
        loss="soft_l1",
        f_scale=_LOSS_PX,
        x_scale=np.array([0.01] * 3 + [0.01 * unit] * 3 + [0.01]),
    )
    x = solved.x
    rotation = start.rotation @ Rotation.from_rotvec(x[:3]).as_matrix()
    scale = start.scale * float(np.exp(x[6]))
    translation = centre - scale * rotation @ (middle + x[3:6])
    rms = float(np.sqrt(np.mean(np.sum(residuals(x).reshape(-1, 2) ** 2, axis=1))))
    return Alignment(rotation, translation, scale), rms
