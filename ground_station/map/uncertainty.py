"""How well a registration is known: its covariance, and what poses in the map inherit of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri, fdtri

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.map.store import MapInfo

_PROBABILITY, _ELLIPSOID = 0.9, 0.95
_FREEDOM = "degrees_of_freedom"
"""Of `map.toml`; where an older program did not write it, it counts as many."""
_REGION = (0.01, 0.99)
"""Quantiles of the landmarks' coordinates that bound the mapped region: single ones lie outside."""


def jacobian(arm: F64) -> F64:
    """How a world point moves with a similarity, (N, 3, 7), at `arm` (N, 3) from its centre.

    The seven are a turn of the world about the centre (rad), a shift (metres), a growth (natural
    logarithm of the scale).
    """
    J = np.zeros((len(arm), 3, 7))
    x, y, z = arm.T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6] = arm
    return J


@dataclass(frozen=True)
class Uncertainty:
    """`covariance` (7, 7) of a similarity about `centre` (3,) in the world; order of `jacobian`.

    `freedom` is the redundancy from which the measurements' scatter was estimated: a covariance of
    few points is itself uncertain.
    """

    covariance: F64
    centre: F64
    freedom: float

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale, as a share of it."""
        return float(np.sqrt(max(self.covariance[6, 6], 0.0)))

    def at(self, places: F64) -> F64:
        """Covariance (N, 3, 3), m², of where the registration puts places (N, 3) of the world."""
        J = jacobian(np.asarray(places, np.float64).reshape(-1, 3) - self.centre)
        return np.asarray(J @ self.covariance @ np.swapaxes(J, 1, 2))

    def sigma_m(self, places: F64) -> F64:
        """Expected (RMS) position error at places (N, 3), metres, in three dimensions."""
        return np.asarray(np.sqrt(np.trace(self.at(places), axis1=1, axis2=2)))

    def radius_m(self, places: F64) -> F64:
        """Radius (N,), metres, of the sphere that holds the position error in 90 %.

        The squared error over its mean is distributed as chi-square over its degrees of freedom, h
        of them (Box, "Some theorems on quadratic forms applied in the study of analysis of variance
        problems, I", Annals of Mathematical Statistics 25, 1954, theorem 3.1). That mean is
        estimated with `freedom`, which makes it Fisher's F: what Student's t is for one number.
        """
        spread = np.maximum(np.linalg.eigvalsh(self.at(places)), 0.0)
        total = spread.sum(axis=1)
        squares = np.maximum(np.sum(spread**2, axis=1), np.finfo(float).tiny)
        h = np.clip(total**2 / squares, 1.0, 3.0)
        return np.asarray(np.sqrt(total * fdtri(h, self.freedom, _PROBABILITY)))


def region(positions: F64) -> tuple[F64, F64]:
    """The middle (3,) and the corners (8, 3) of the box that holds the landmarks (M, 3)."""
    low, high = np.quantile(positions, _REGION, axis=0)
    chosen = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    return (low + high) / 2, np.where(chosen == 1, high, low)


def describe(found: Uncertainty, positions: F64) -> dict[str, Any]:
    """What `map.toml` says of a registration of landmarks (M, 3) in the world, metres."""
    report: dict[str, Any] = {
        "scale_sigma_percent": 100 * found.scale_sigma,
        _FREEDOM: float(found.freedom),
    }
    if len(positions):
        middle, corners = region(positions)
        worst = corners[[int(np.argmax(found.sigma_m(corners)))]]
        for name, place in (("centre", middle[None]), ("corner", worst)):
            report[f"{name}_m"] = [round(float(x), 3) for x in place[0]]
            report[f"{name}_sigma_m"] = float(found.sigma_m(place)[0])
            report[f"{name}_90_percent_m"] = float(found.radius_m(place)[0])
    return report | {
        "covariance_order": ["turn_x", "turn_y", "turn_z", "x_m", "y_m", "z_m", "log_scale"],
        "covariance_about_m": found.centre.tolist(),
        "covariance": found.covariance.tolist(),
    }


_MOST = 1e6
"""Of a deviation, a variance, metres or radians: what is more is no registration's."""


@dataclass(frozen=True)
class Accuracy:
    """How far a map's places are off the world's, which every pose found in it inherits.

    `sigma_rad` and `sigma_m` are deviations along one axis of a part of the map against the whole:
    what keyframes, or measured places, scatter about the registration, by which the map is bent.
    `registration` is how well that similarity itself is known; None where the map does not say.
    """

    sigma_rad: float = 0.0
    sigma_m: float = 0.0
    registration: Uncertainty | None = None

    def at(self, wTc: F64) -> F64:
        """Covariance (6, 6) of the right tangent of a pose (4, 4), rad before metres.

        The scatter about the registration counts as independent of it, and in all axes alike.
        """
        own = np.diag([self.sigma_rad**2] * 3 + [self.sigma_m**2] * 3)
        if self.registration is None:
            return own
        R, arm = wTc[:3, :3], wTc[:3, 3] - self.registration.centre
        moved = np.zeros((6, 7))
        moved[:3, :3] = R.T  # a turn of the world, in the camera's axes
        moved[3:] = R.T @ jacobian(arm[None])[0]
        return np.asarray(own + moved @ self.registration.covariance @ moved.T)


def accuracy(info: MapInfo) -> Accuracy:
    """Of a map, by what its registration left; nothing where it is not in the world's frame.

    A key that an older program did not write counts as no error. Raises `MapError` for one that is
    no such number.
    """
    if not info.registered:
        return Accuracy()
    table = info.registration
    deviation_m = "sigma_m" if "sigma_m" in table else "point_sigma_m"
    known = None
    if "covariance" in table:
        covariance = _numbers(table, "covariance", (7, 7))
        centre = _numbers(table, "covariance_about_m", (3,))
        least = np.linalg.eigvalsh(covariance)[0]
        if not np.allclose(covariance, covariance.T) or least < -1e-9 * np.trace(covariance):
            raise MapError("map.toml, registration: 'covariance' is not a covariance")
        freedom = max(1.0, float(_numbers({_FREEDOM: _MOST / 2} | table, _FREEDOM, ())))
        known = Uncertainty(covariance * _of_few(freedom), centre, freedom)
    return Accuracy(
        _deviation(table, "sigma_deg", np.pi / 180), _deviation(table, deviation_m), known
    )


def _of_few(freedom: float) -> float:
    """By what a covariance whose scale was estimated with so much redundancy is to be multiplied,
    so that the ellipsoid of position that is drawn from it holds 95 %: chi-square's quantile
    becomes Fisher's F's (Hotelling, "The generalization of Student's ratio", 1931)."""
    return float(3 * fdtri(3, freedom, _ELLIPSOID) / chdtri(3, 1 - _ELLIPSOID))


def _deviation(table: dict[str, Any], key: str, unit: float = 1.0) -> float:
    value = unit * float(_numbers(table, key, ())) if key in table else 0.0
    if value < 0:
        raise MapError(f"map.toml, registration: '{key}' is less than 0")
    return value


def _numbers(table: dict[str, Any], key: str, shape: tuple[int, ...]) -> F64:
    try:
        values = np.asarray(table.get(key), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != shape or not (np.abs(values) < _MOST).all():  # what is no number fails, too
        size = "x".join(map(str, shape)) + " numbers" if shape else "a number"
        raise MapError(f"map.toml, registration: '{key}' must be {size} below {_MOST:.0e}")
    return values
