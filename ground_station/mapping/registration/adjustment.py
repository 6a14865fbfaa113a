"""The similarity between points known in a model and in the world, weighted by both noises.

A known place has two errors: that of its coordinates in the model, which the observations' geometry
tells, and that of its coordinates in the world, with all that bends the model, which nobody tells.
Minimising pixels would take the second for none: five centimetres are 25 pixels at one metre and
two at twelve, and the nearest points would carry all. So the second is estimated from what is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import bisect
from scipy.spatial.transform import Rotation
from scipy.special import fdtri

from ground_station.arrays import F64, I64, Bools
from ground_station.errors import GeometryError, MapError
from ground_station.geometry.alignment import Alignment, align
from ground_station.map.uncertainty import Uncertainty, jacobian
from ground_station.mapping.registration.registration import check_spread

_ITERATIONS = 100
_CONVERGED = 1e-10
_READMIT = 0.999
_FLOOR = 1e-9
"""The least scatter, in extents of the points: data without any noise stay solvable."""


@dataclass(frozen=True)
class KnownPoints:
    """N places known in a model and in the world.

    `model` (N, 3) and its `covariance` (N, 3, 3), model units; `world` (N, 3), metres, of which the
    first `axes` are known: three, or two of a floor plan. Places that were measured as one thing,
    such as the corners of a tag, share a number in `group` (N,).
    """

    model: F64
    covariance: F64
    world: F64
    group: I64
    axes: int = 3

    def __len__(self) -> int:
        return len(self.model)

    def of(self, chosen: Bools) -> KnownPoints:
        """The chosen ones, (N,) bool."""
        return KnownPoints(
            self.model[chosen],
            self.covariance[chosen],
            self.world[chosen],
            self.group[chosen],
            self.axes,
        )

    def off_m(self, fit: Alignment) -> F64:
        """How far a similarity puts them off what is known of the world (N,), metres."""
        off = (fit.apply(self.model) - self.world)[:, : self.axes]
        return np.asarray(np.linalg.norm(off, axis=1))

    @property
    def groups(self) -> int:
        """How many things were measured."""
        return len(np.unique(self.group))


@dataclass(frozen=True)
class Upright:
    """What is known of a model's vertical, for places of which the height is not known.

    `direction` (3,), the unit vector up in the model, to `sigma_rad` about each horizontal axis;
    the horizontal plane at `level` along it, model units, to `sigma_level`, is at `height_m`.
    """

    direction: F64
    sigma_rad: float
    level: float
    sigma_level: float
    height_m: float = 0.0


@dataclass(frozen=True)
class Adjusted:
    """A similarity, how well it is known, and the estimated scatter of the places, one axis."""

    fit: Alignment
    uncertainty: Uncertainty
    scatter_m: float


def moved(fit: Alignment, centre: F64, step: F64) -> Alignment:
    """The similarity after a small change (7,) about `centre` (3,), in the order of `jacobian`."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    grow = float(np.exp(step[6]))
    translation = centre + grow * turn @ (fit.translation - centre) + step[3:6]
    return Alignment(turn @ fit.rotation, translation, grow * fit.scale)


def adjust(start: Alignment, points: KnownPoints, upright: Upright | None = None) -> Adjusted:
    """Generalised least squares from `start`, by Gauss-Newton.

    Each place weighs by its own covariance in the model and a scatter that all have in common. That
    scatter is what makes the weighted squares of the residuals equal to their redundancy (Paule and
    Mandel, "Consensus values and weighting factors", J. Res. NBS 87, 1982), none where they are
    smaller without it. Of a thing with several places each counts by that share, as their errors
    are not independent (the design effect for whole clusters, Kish 1965). Raises `MapError` where
    the places leave the similarity open.
    """
    k, n = points.axes, len(points)
    fit, step = start, np.full(7, np.inf)
    centre = fit.apply(points.model).mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum((points.world[:, :k] - centre[:k]) ** 2, axis=1))))
    open_ = 7 if upright is None else 4  # the vertical and a height are known without the places
    share = n / points.groups
    independent = max(k * points.groups - open_, 1)
    floor = (_FLOOR * extent) ** 2
    variance, normal = floor, np.eye(7)
    for _ in range(_ITERATIONS):
        placed = fit.apply(points.model)
        residual = (points.world - placed)[:, :k]
        R = fit.rotation
        own = (fit.scale**2 * R @ points.covariance @ R.T)[:, :k, :k]
        before, variance = variance, max(_scatter(residual, own, share * independent), floor)
        J = jacobian(placed - centre)[:, :k]
        JW = np.swapaxes(J, 1, 2) @ np.linalg.inv(own + variance * np.eye(k))
        normal, pull = (JW @ J).sum(axis=0), (JW @ residual[:, :, None]).sum(axis=0)[:, 0]
        normal, pull = normal / share, pull / share
        if upright is not None:
            more, pulls = _vertical(upright, fit, centre)
            normal, pull = normal + more, pull + pulls
        try:
            step = np.linalg.solve(normal, pull)
        except np.linalg.LinAlgError:
            step = np.full(7, np.nan)
        if not np.isfinite(step).all() or np.abs(step[[0, 1, 2, 6]]).max() > 10:
            raise MapError(f"registration: the {n} places do not determine a similarity")
        fit = moved(fit, centre, step)
        still = np.abs(step[3:6]).max() < _CONVERGED * extent
        if still and np.abs(step).max() < 1e3 * _CONVERGED and np.isclose(before, variance):
            break
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True), np.float64)
    return Adjusted(fit, Uncertainty(covariance, centre, independent), float(np.sqrt(variance)))


def adjust_agreeing(
    start: Alignment, points: KnownPoints, agree: Bools, upright: Upright | None = None
) -> tuple[Adjusted, Bools]:
    """Adjusts the places that `agree` (N,) says, and those others that turn out to, and which.

    The consensus of few places is narrow by chance: of six with the same noise it leaves one out
    now and then. A place is another one's only where it lies outside of where the adjusted ones
    expect it in 99.9 % (Fisher's F, their scatter being estimated; Baarda's data snooping, 1968).
    """
    while True:
        found = adjust(start, points.of(agree), upright)
        placed = found.fit.apply(points.model)
        k, R = points.axes, found.fit.rotation
        own = found.fit.scale**2 * R @ points.covariance @ R.T
        expected = found.uncertainty.at(placed) + own + found.scatter_m**2 * np.eye(3)
        off = (points.world - placed)[:, :k, None]
        square = (np.swapaxes(off, 1, 2) @ np.linalg.solve(expected[:, :k, :k], off))[:, 0, 0]
        now = agree | (square <= k * fdtri(k, found.uncertainty.freedom, _READMIT))
        if (now == agree).all():
            return found, agree
        start, agree = found.fit, now


def held_out(
    points: KnownPoints,
    width: float,
    start: Alignment | None = None,
    upright: Upright | None = None,
) -> tuple[F64, list[float]]:
    """Each point's error (N,), metres, without the thing that it belongs to, and the scales then.

    NaN where the others leave the similarity open, as on a line, narrower than `width` times long.
    An adjustment begins at `start`, or where the others are nearest.
    """
    error = np.full(len(points), np.nan)
    scales: list[float] = []
    for group in np.unique(points.group):
        mine = points.group == group
        others = points.of(~mine)
        try:
            check_spread(others.world[:, : points.axes], "points", width)
            begun = start or align(others.model, others.world, True)
            fit = adjust(begun, others, upright).fit
        except (MapError, GeometryError):
            continue
        error[mine] = points.of(mine).off_m(fit)
        scales.append(fit.scale)
    return error, scales


def _scatter(residual: F64, own: F64, freedom: float) -> float:
    """The variance, m², which on top of `own` (N, k, k) explains residuals (N, k)."""
    value, vector = np.linalg.eigh(own)
    squares = np.einsum("nki,nk->ni", vector, residual) ** 2
    value = np.maximum(value, 0.0)

    def excess(variance: float) -> float:
        return float(np.sum(squares / np.maximum(value + variance, 1e-300))) - freedom

    high = float(squares.sum()) / freedom  # with it, even without `own`, nothing is left over
    if high == 0.0 or excess(0.0) <= 0:
        return 0.0
    return float(bisect(excess, 0.0, 2 * high, xtol=1e-12 * high, rtol=1e-12))


def _vertical(upright: Upright, fit: Alignment, centre: F64) -> tuple[F64, F64]:
    """Normal equations (7, 7), (7,) of an upward direction and of a level's height."""
    up = fit.rotation @ upright.direction
    # A turn t moves it by t x up; what is off is what x and y of it are not zero.
    J = np.zeros((3, 7))
    J[0, 1], J[0, 2] = up[2], -up[1]
    J[1, 0], J[1, 2] = -up[2], up[0]
    # The level's own point below the centre, so that a turn about it hardly matters.
    middle = (centre - fit.translation) @ fit.rotation / fit.scale
    foot = middle + (upright.level - float(upright.direction @ middle)) * upright.direction
    placed = fit.apply(foot[None])
    J[2] = jacobian(placed - centre)[0, 2]
    sigma = np.array([upright.sigma_rad, upright.sigma_rad, fit.scale * upright.sigma_level])
    residual = np.array([-up[0], -up[1], upright.height_m - placed[0, 2]])
    JW = J.T / np.maximum(sigma, 1e-12) ** 2
    return JW @ J, JW @ residual
