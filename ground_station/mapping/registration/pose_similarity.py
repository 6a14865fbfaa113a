"""The similarity from a model's poses to a trajectory's, by positions and orientations together.

Positions and orientations are two groups of measurements of one rotation. Each group counts by its
own scatter, which the fit estimates (`joint_similarity`); wrong poses are found in each group apart
(`robust_similarity`, `robust_rotation`); and orientations of another frame than the camera's are
recognised by what the positions say (`orientation_offset`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.arrays import F64, Bools
from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.mapping.registration.registration import GATE_DEVIATION, MIN_POINTS

_CANDIDATES = 2000
_ITERATIONS = 100
_CONVERGED = 1e-9
_FLOOR = 1e-9
"""The least scatter, in rad and in extents of the path: data without any noise stay solvable."""
_SAME_CAMERA_DEG = 1.0
"""Two calibrations of one camera differ in its principal point: 9 pixels at a focal length of 500
are one degree. An offset below it is no sign of another frame."""
_SIGNIFICANT = 16.27
"""99.9 % of chi-square with three degrees of freedom."""


@dataclass(frozen=True)
class Positions:
    """Positions of a model (N, 3), its units, and of a trajectory (N, 3), metres."""

    source: F64
    target: F64

    def of(self, chosen: Bools) -> Positions:
        """The chosen ones, (N,) bool."""
        return Positions(self.source[chosen], self.target[chosen])

    def centred(self) -> tuple[F64, F64, F64, F64]:
        """Both about their means, and the means."""
        mean_x, mean_y = self.source.mean(axis=0), self.target.mean(axis=0)
        return self.source - mean_x, self.target - mean_y, mean_x, mean_y

    def spread_m(self) -> float:
        """Standard deviation of the trajectory's path, along one axis, metres."""
        return float(np.sqrt(np.mean(self.centred()[1] ** 2)))

    def with_rotation(self, rotation: F64) -> Alignment:
        """The best similarity of a known rotation. Raises `MapError` where its scale is open."""
        dx, dy, mean_x, mean_y = self.centred()
        squares = float(np.sum(dx * dx))
        scale = float(np.sum(dy * (dx @ rotation.T))) / squares if squares > 0 else np.nan
        if not (np.isfinite(scale) and scale > 0):
            raise MapError(
                f"registration: the {len(dx)} positions do not determine a scale: they lie in one "
                "place, or their path does not run as the orientations say"
            )
        return Alignment(rotation, mean_y - scale * rotation @ mean_x, scale)

    def information(self, fit: Alignment, sigma_m: float) -> F64:
        """What they know of the rotation, (3, 3), 1/rad²: of a turn of the world about their mean.

        Scale and translation are independent of it, the positions being about their mean.
        """
        a = fit.scale * self.centred()[0] @ fit.rotation.T
        return np.asarray((np.sum(a * a) * np.eye(3) - a.T @ a) / sigma_m**2)

    def jackknife_scales(self, rotation: F64) -> list[float]:
        """The scales of a known rotation with each position left out once."""
        n = len(self.source)
        if n <= MIN_POINTS:
            return []
        dx, dy, _, _ = self.centred()
        # Without one of n, sums about the new mean lose n / (n - 1) of its product about the old.
        products, squares = np.sum(dy * (dx @ rotation.T), axis=1), np.sum(dx * dx, axis=1)
        lost = n / (n - 1)
        above = products.sum() - lost * products
        below = squares.sum() - lost * squares
        good = (above > 0) & (below > 0)
        return [float(scale) for scale in above[good] / below[good]]

    def floor_m(self) -> float:
        """The least scatter, metres, that is told from none."""
        dy = self.centred()[1]
        return _FLOOR * float(np.sqrt(np.mean(np.sum(dy * dy, axis=1))))


@dataclass(frozen=True)
class JointFit:
    """A similarity and the scatter of each group about it, along one axis, metres and radians."""

    fit: Alignment
    sigma_m: float
    sigma_rad: float


def rotation_vectors(rotation: F64) -> F64:
    """Rotation vectors (..., 3), radians, of rotations (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def robust_rotation(rotations: F64, seed: int) -> tuple[F64, Bools]:
    """The rotation that most of `rotations` (N, 3, 3) agree with, and which agree, (N,).

    The one with the least median of angles to the others wins (Rousseeuw 1984); those within 2.5
    robust deviations of it are averaged, until they stay the same ones.
    """
    n = len(rotations)
    quaternion = Rotation.from_matrix(rotations).as_quat()
    chosen = np.arange(n)
    if n > _CANDIDATES:
        chosen = np.random.default_rng(seed).choice(n, _CANDIDATES, replace=False)
    cosine = np.abs(quaternion[chosen] @ quaternion.T)
    middle = np.partition(cosine, n - 1 - n // 2, axis=1)[:, n - 1 - n // 2]
    # The half that agrees is at or below this angle, the candidate's own of zero included.
    result = rotations[chosen[np.argmax(middle)]]
    median = np.median(_angles(rotations, result))
    gate = GATE_DEVIATION * 1.4826 * (1 + 5 / max(n - 1, 1)) * median + _FLOOR
    inliers = np.zeros(n, dtype=bool)
    for _ in range(10):
        now = _angles(rotations, result) <= gate
        if (now == inliers).all() or not now.any():
            break
        inliers = now
        result = _nearest_rotation(rotations[inliers].sum(axis=0))
    return result, inliers


def similarity_on_a_line(positions: Positions, rotation: F64, seed: int) -> tuple[Alignment, Bools]:
    """The similarity where the positions leave the roll about their line open, and which agree.

    `rotation` (3, 3) gives the roll; it is turned by no more than brings line onto line. Pairs are
    drawn, the one with the least median wins, as `robust_similarity` does with triples. Raises
    `MapError` for positions in one place.
    """
    x, y = positions.source, positions.target
    n = len(x)
    if n * (n - 1) // 2 <= _CANDIDATES:
        pairs = np.stack(np.triu_indices(n, 1), axis=1)
    else:
        rng = np.random.default_rng(seed)
        pairs = np.array([rng.choice(n, 2, replace=False) for _ in range(_CANDIDATES)])
    rank = min(n - 1, max(n // 2, 2))  # more than the pair, which fits itself
    best, best_score = None, np.inf
    for i, j in pairs:
        two = Positions(x[[i, j]], y[[i, j]])
        try:
            candidate = _line_onto_line(two, rotation)
        except MapError:
            continue
        score = np.sort(np.linalg.norm(candidate.apply(x) - y, axis=1))[rank]
        if score < best_score:
            best, best_score = candidate, float(score)
    if best is None:
        raise MapError(f"registration: the {n} positions lie in one place: the scale is open")
    gate = GATE_DEVIATION * 1.4826 * (1 + 5 / max(n - 2, 1)) * best_score + positions.floor_m()
    inliers = np.zeros(n, dtype=bool)
    for _ in range(10):
        now = np.linalg.norm(best.apply(x) - y, axis=1) <= gate
        if (now == inliers).all():
            break
        if now.sum() < MIN_POINTS:
            raise MapError(f"registration: fewer than {MIN_POINTS} of {n} positions agree")
        inliers = now
        best = _line_onto_line(positions.of(inliers), rotation)
    return best, inliers


def joint_similarity(positions: Positions, rotations: F64, start: Alignment) -> JointFit:
    """The similarity nearest to positions (N, 3) and to rotations (M, 3, 3) of model to world.

    Minimises Σ ‖dp‖²/σp² + Σ ‖dθ‖²/σr² over rotation, translation and scale. Given the scale the
    rotation is that of a Procrustes problem (Umeyama 1991, with the rotations' sum added to the
    positions' covariance; for small angles 3 − trace(dR) is ‖dθ‖²), given the rotation the others
    are, so both take turns. σp and σr begin as the groups' own scatter, the positions' about
    `start`, the rotations' about their mean; then each is what is left of its residuals over the
    redundancy (Helmert's variance components, Förstner 1979) until they stay.
    """
    n, m = len(positions.source), len(rotations)
    dx, dy, _, _ = positions.centred()
    covariance, total = dy.T @ dx, rotations.sum(axis=0)
    floor_m = positions.floor_m()
    sigma_m = max(position_scatter(positions, start), floor_m)
    sigma_rad = max(_scatter_rad(rotations, _nearest_rotation(total), 3.0), _FLOOR)
    fit = positions.with_rotation(_nearest_rotation(total))
    for _ in range(_ITERATIONS):
        before = np.array([sigma_m, sigma_rad])
        fit = positions.with_rotation(
            _nearest_rotation(2 * fit.scale * covariance / sigma_m**2 + total / sigma_rad**2)
        )
        known = positions.information(fit, sigma_m)
        share = float(np.trace(np.linalg.solve(known + m / sigma_rad**2 * np.eye(3), known)))
        error = fit.apply(positions.source) - positions.target
        # Translation and scale are the positions' alone; of the rotation's three, `share`.
        sigma_m = max(float(np.sqrt(np.sum(error**2) / (3 * n - 4 - share))), floor_m)
        sigma_rad = max(_scatter_rad(rotations, fit.rotation, 3 - share), _FLOOR)
        if np.allclose([sigma_m, sigma_rad], before, rtol=_CONVERGED, atol=0):
            break
    return JointFit(fit, sigma_m, sigma_rad)


@dataclass(frozen=True)
class Offset:
    """A constant rotation between a trajectory's axes and the camera's, and what hangs on it.

    `share` of the orientations agree on it, with `scatter_deg` (root of the mean squared angle).
    """

    angle_deg: float
    scatter_deg: float
    another_frame: bool
    share: float


def orientation_offset(
    fit: Alignment, information: F64, model: F64, trajectory: F64, seed: int
) -> Offset:
    """How far a trajectory's orientations are off the camera's by a constant rotation B.

    `trajectory` (N, 3, 3) is exp(ε) · R · `model` · B, with R of a similarity by positions, which
    know their own error ε with an `information` (3, 3), 1/rad². Where the camera turns enough,
    orientations alone tell B from ε; where it does not, the positions must. B is another frame when
    it is more than one degree and is not the scatter's (Wald test, 99.9 %). Scatter is taken as
    independent from pose to pose; drift makes it look surer than it is, which errs towards leaving
    orientations out.
    """
    placed = fit.rotation @ model
    B, inliers = robust_rotation(np.swapaxes(placed, 1, 2) @ trajectory, seed)
    placed, trajectory = placed[inliers], trajectory[inliers]
    n = len(placed)
    # A turn is half a circle at most: what the positions leave open stays finite.
    prior = information + np.eye(3) / np.pi**2
    E, normal, sigma = np.eye(3), np.eye(6), 0.0
    for _ in range(10):
        there = E @ placed @ B
        left = rotation_vectors(np.swapaxes(there, 1, 2) @ trajectory)
        sigma = max(float(np.sqrt(np.sum(left**2) / max(3 * n - 3, 1))), _FLOOR)
        mean = there.sum(axis=0) / sigma**2
        one = n / sigma**2 * np.eye(3)
        normal = np.block([[one + prior, mean], [mean.T, one]])
        pull = np.einsum("nij,nj->i", there, left) / sigma**2 - prior @ rotation_vectors(E)
        step = np.linalg.solve(normal, np.concatenate([pull, left.sum(axis=0) / sigma**2]))
        E, B = _exp(step[:3]) @ E, B @ _exp(step[3:])
        if np.abs(step).max() < 1e-9:
            break
    offset = rotation_vectors(B)
    angle_deg = float(np.degrees(np.linalg.norm(offset)))
    first, cross, last = normal[:3, :3], normal[:3, 3:], normal[3:, 3:]
    known = last - cross.T @ np.linalg.solve(first, cross)
    significant = bool(offset @ known @ offset > _SIGNIFICANT)
    scatter_deg = float(np.degrees(np.sqrt(3) * sigma))
    another = significant and angle_deg > _SAME_CAMERA_DEG
    return Offset(angle_deg, scatter_deg, another, float(inliers.mean()))


def position_scatter(positions: Positions, fit: Alignment) -> float:
    """The positions' standard deviation about a similarity fitted to them, one axis, metres."""
    error = fit.apply(positions.source) - positions.target
    return float(np.sqrt(np.sum(error**2) / (3 * len(error) - 7)))


def _line_onto_line(positions: Positions, rotation: F64) -> Alignment:
    """The similarity whose rotation differs from `rotation` by the least that aligns the lines."""
    dx, dy, _, _ = positions.centred()
    if not np.linalg.norm(dx) > 0:
        raise MapError("registration: the positions lie in one place")
    U, D, Vt = np.linalg.svd(dy.T @ dx)
    if not D[0] > 0:
        raise MapError("registration: the positions lie in one place")
    a, b = rotation @ Vt[0], U[:, 0]
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12 and cosine < 0:
        raise MapError("registration: the path runs against the orientations")
    turn = _exp(axis / sine * np.arctan2(sine, cosine)) if sine > 1e-12 else np.eye(3)
    return positions.with_rotation(turn @ rotation)


def _scatter_rad(rotations: F64, about: F64, parameters: float) -> float:
    error = rotation_vectors(rotations @ about.T)
    return float(np.sqrt(np.sum(error**2) / max(3 * len(rotations) - parameters, 1e-9)))


def _nearest_rotation(M: F64) -> F64:
    """The rotation R of the greatest trace(Rᵀ M)."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray((U * [1.0, 1.0, sign]) @ Vt)


def _angles(rotations: F64, about: F64) -> F64:
    return np.asarray(np.linalg.norm(rotation_vectors(rotations @ about.T), axis=1))


def _exp(vector: F64) -> F64:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
