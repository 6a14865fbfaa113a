"""People who walk back and forth where the map has seen nobody.

Each is an upright figure of legs, a coat with a pattern and a head, lit as the scene is on average:
their shadows, and what they hide from each other's light, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F64, U8, Bools
from ground_station.simulator.scene import Scene, SimulatorError

MOST = 100
_SPEED_M_S = 0.8, 1.6
"""How fast people go indoors."""
_SHORTEST_M, _CLEAR_M = 3.0, 0.4
_TRIES = 2000
_PATTERN = 12
"""Patches of a coat's texture along a side: what a key point detector likes."""


@dataclass(frozen=True)
class Walker:
    """One who goes back and forth between `ends_m` (2, 2); `along_m` of the way are behind at 0 s.

    Colours are 8-bit: a `coat` (S, S, 3) and its sides alike, `legs` (3,), `skin` (3,).
    """

    ends_m: F64
    speed_m_s: float
    along_m: float
    coat: U8
    legs: U8
    skin: U8

    def place(self, time_s: float) -> F64:
        """x, y in metres and the heading in radians, from x to y."""
        way = self.ends_m[1] - self.ends_m[0]
        length = float(np.hypot(*way))
        gone = (self.along_m + self.speed_m_s * time_s) % (2 * length)
        back = gone > length
        x, y = self.ends_m[0] + way * ((2 * length - gone if back else gone) / length)
        return np.array([x, y, np.arctan2(way[1], way[0]) + np.pi * back])


def walkers(scene: Scene, count: int, level: float, rng: np.random.Generator) -> list[Walker]:
    """So many people on straight ways that are free of what stands on the plan.

    `level` is the middle code, 0 to 255, of the scene's textures. Raises `SimulatorError`
    where there is no such way.
    """
    found: list[Walker] = []
    for _ in range(_TRIES):
        if len(found) == count:
            return found
        ends = rng.uniform(0.0, scene.size_m[:2], (2, 2))
        steps = np.linspace(0.0, 1.0, 60)[:, None]
        if np.hypot(*(ends[1] - ends[0])) < _SHORTEST_M:
            continue
        if _taken(scene, ends[0] + steps * (ends[1] - ends[0])).any():
            continue
        patches = level * rng.uniform(0.4, 2.0, (_PATTERN, _PATTERN, 3))
        coat = cv2.resize(patches, (64, 64), interpolation=cv2.INTER_NEAREST)
        plain = np.outer(level * rng.uniform(0.4, 1.8, 2), np.ones(3))
        legs, skin = _codes(plain)
        found.append(
            Walker(ends, rng.uniform(*_SPEED_M_S), rng.uniform(0.0, 20.0), _codes(coat), legs, skin)
        )
    raise SimulatorError(f"scene '{scene.name}' has no room for {count} people who walk")


def _codes(colours: npt.ArrayLike) -> U8:
    return np.clip(np.rint(colours), 0, 255).astype(np.uint8)


def _taken(scene: Scene, places: F64) -> Bools:
    """Where (N,) something stands, or the scene ends, at places (N, 2)."""
    taken = ((places < _CLEAR_M) | (places > np.array(scene.size_m[:2]) - _CLEAR_M)).any(axis=1)
    for thing in scene.footprints:
        if thing.kind != "balcony":  # which is overhead
            low, high = np.array(thing.bounds_m[:2]), np.array(thing.bounds_m[2:])
            taken |= ((places > low - _CLEAR_M) & (places < high + _CLEAR_M)).all(axis=1)
    return np.asarray(taken, bool)
