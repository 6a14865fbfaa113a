"""Least-squares alignment of two point sets by a rigid motion or a similarity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, Bools
from ground_station.errors import GeometryError

MIN_POINTS = 3
RANK_TOLERANCE = 1e-12
"""Second over first singular value of the covariance: a millionth of the extent, squared."""


@dataclass(frozen=True)
class Alignment:
    """target = scale · rotation · source + translation: (3, 3), (3,) in target units, a number."""

    rotation: F64
    translation: F64
    scale: float

    def apply(self, points: npt.ArrayLike) -> F64:
        """Points (N, 3) of the source frame in the target frame."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def apply_poses(self, wTc: npt.ArrayLike) -> F64:
        """Poses (N, 4, 4) of the source frame in the target frame; rotations stay rotations."""
        source = np.asarray(wTc, dtype=np.float64)
        result = source.copy()
        result[..., :3, :3] = self.rotation @ source[..., :3, :3]
        result[..., :3, 3] = self.apply(source[..., :3, 3])
        return result


def align(
    source: npt.ArrayLike,
    target: npt.ArrayLike,
    with_scale: bool,
    weights: npt.ArrayLike | None = None,
) -> Alignment:
    """The motion (similarity `with_scale`) that takes source (N, 3) nearest to target (N, 3).

    Minimises Σ wᵢ ‖yᵢ − (c R xᵢ + t)‖² over proper rotations; `weights` (N,), not negative, count
    equally when not given. Umeyama, "Least-squares estimation of transformation parameters between
    two point patterns", IEEE PAMI 13(4), 1991; equation numbers are the paper's.

    Raises `GeometryError` for fewer than 3 points, numbers that are not finite, and points on one
    line or in one place, about which a rotation is not determined.
    """
    x, y = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    w = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    used = int(np.count_nonzero(w))
    if used < MIN_POINTS:
        raise GeometryError(f"alignment: {used} points; at least {MIN_POINTS} are needed")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y))):
        raise GeometryError("alignment: a coordinate is not a finite number")

    w = w / w.sum()
    rotation, translation, scale, determined = similarities(x, y, w)
    if not determined:
        raise GeometryError("alignment: the points lie on one line or in one place")
    if not with_scale:
        return Alignment(rotation, w @ y - rotation @ (w @ x), 1.0)
    return Alignment(rotation, translation, float(scale))


def similarities(x: F64, y: F64, w: F64) -> tuple[F64, F64, F64, Bools]:
    """`align` with scale for many sets at once: x and y (..., N, 3), finite; weights w (N,), sum 1.

    Rotations (..., 3, 3), translations (..., 3), scales (...), and which sets determine theirs.
    """
    mean_x, mean_y = w @ x, w @ y  # eq. 34, 35
    dx, dy = x - mean_x[..., None, :], y - mean_y[..., None, :]
    variance_x = np.sum(dx * dx, axis=-1) @ w  # eq. 36
    covariance = np.swapaxes(dy * w[:, None], -1, -2) @ dx  # eq. 38
    U, D, Vt = np.linalg.svd(covariance)
    determined = D[..., 1] > RANK_TOLERANCE * D[..., 0]
    S = np.ones_like(D)  # eq. 39, and 43 where the points lie in one plane
    S[..., 2] = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    rotation = (U * S[..., None, :]) @ Vt  # eq. 40
    with np.errstate(divide="ignore", invalid="ignore"):  # points in one place
        scale = np.sum(D * S, axis=-1) / variance_x  # eq. 42
        translation = mean_y - scale[..., None] * np.einsum("...ij,...j", rotation, mean_x)  # 41
    return rotation, translation, scale, determined


def spread_out(places: F64, count: int, least: float = 0.0) -> list[int]:
    """Indices of up to `count` places (N, D), N >= 1, far from each other, greedily.

    None is nearer than `least` to one before it.
    """
    picked = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
    while len(picked) < min(count, len(places)):
        gaps = np.linalg.norm(places[:, None] - places[picked][None], axis=2).min(axis=1)
        if gaps.max() < least:
            break
        picked.append(int(gaps.argmax()))
    return picked
