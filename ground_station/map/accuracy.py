"""What `map.toml` knows of a registered map's own errors, as a covariance of poses found in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ground_station.arrays import F64
from ground_station.errors import MapError
from ground_station.map.store import MapInfo
from ground_station.map.uncertainty import Uncertainty, jacobian

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
        known = Uncertainty(covariance, centre, 1.0)
    return Accuracy(
        _deviation(table, "sigma_deg", np.pi / 180), _deviation(table, deviation_m), known
    )


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
