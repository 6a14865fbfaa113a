"""How well a similarity is known: its covariance, and what that means at a place of the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import fdtri

from ground_station.arrays import F64

PROBABILITY = 0.9
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

    def radius_m(self, places: F64, probability: float = PROBABILITY) -> F64:
        """Radius (N,), metres, of the sphere that holds the position error so often.

        The squared error over its mean is distributed as chi-square over its degrees of freedom, h
        of them (Box, "Some theorems on quadratic forms applied in the study of analysis of variance
        problems, I", Annals of Mathematical Statistics 25, 1954, theorem 3.1). That mean is
        estimated with `freedom`, which makes it Fisher's F: what Student's t is for one number.
        """
        spread = np.maximum(np.linalg.eigvalsh(self.at(places)), 0.0)
        total = spread.sum(axis=1)
        squares = np.maximum(np.sum(spread**2, axis=1), np.finfo(float).tiny)
        h = np.clip(total**2 / squares, 1.0, 3.0)
        return np.asarray(np.sqrt(total * fdtri(h, self.freedom, probability)))


def region(positions: F64) -> tuple[F64, F64]:
    """The middle (3,) and the corners (8, 3) of the box that holds the landmarks (M, 3)."""
    low, high = np.quantile(positions, _REGION, axis=0)
    chosen = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    return (low + high) / 2, np.where(chosen == 1, high, low)


def describe(found: Uncertainty, positions: F64) -> dict[str, Any]:
    """What `map.toml` says of a registration of landmarks (M, 3) in the world, metres."""
    report: dict[str, Any] = {
        "scale_sigma_percent": 100 * found.scale_sigma,
        "degrees_of_freedom": float(found.freedom),
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
