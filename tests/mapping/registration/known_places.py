"""Known places of a hall, in the world and in a map of any coordinates, for the tests."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from ground_station.geometry.alignment import Alignment
from ground_station.mapping.registration.adjustment import KnownPoints

HALL_M = np.array([24.0, 16.0, 6.0])


def similarity(seed: int = 1) -> Alignment:
    """Some similarity from a map to the world."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Alignment(rotation, np.array([12.0, 7.0, 2.0]), 1.7)


def in_map(truth: Alignment, world: np.ndarray) -> np.ndarray:
    """Places (N, 3) of the world in the map's coordinates."""
    return (world - truth.translation) @ truth.rotation / truth.scale


def known(truth: Alignment, world: np.ndarray, told: np.ndarray, **more) -> KnownPoints:
    """Places that are in the world where nobody knows and of which `told` is said."""
    n = len(world)
    defaults = {"covariance": np.zeros((n, 3, 3)), "group": np.arange(n)}
    return KnownPoints(model=in_map(truth, world), world=told, **(defaults | more))


def hall(truth: Alignment, seed: int = 0) -> SimpleNamespace:
    """Landmarks and keyframes of a hall in a map's coordinates: walls, floor, ceiling, pillars."""
    rng = np.random.default_rng(seed)
    world = rng.uniform(0, 1, (4000, 3)) * HALL_M
    face = rng.integers(0, 6, len(world))
    for axis in range(3):
        world[face == 2 * axis, axis] = 0.0
        world[face == 2 * axis + 1, axis] = HALL_M[axis]
    pillars = np.array(
        [[6.0, 4.0], [6.0, 12.0], [18.0, 4.0], [18.0, 12.0], [12.0, 8.0], [3.0, 14.0]]
    )
    stems = np.repeat(pillars, 40, axis=0) + 0.05 * rng.normal(size=(240, 2))
    world = np.vstack([world, np.column_stack([stems, rng.uniform(0.3, 5.5, 240)])])
    yaw = rng.uniform(0, 2 * np.pi, 80)
    pitch, roll = rng.normal(0, [[0.15], [0.05]], (2, 80))
    level = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turn = (Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])) * level).as_matrix()
    wTc = np.tile(np.eye(4), (80, 1, 1))
    wTc[:, :3, :3] = truth.rotation.T @ turn
    wTc[:, :3, 3] = in_map(truth, rng.uniform([2, 2, 1], [22, 14, 3], (80, 3)))
    return SimpleNamespace(
        landmarks=Landmarks(np.arange(len(world)) * 3 + 7, in_map(truth, world)),
        keyframes=SimpleNamespace(wTc=wTc),
        info=SimpleNamespace(registered=False),
        pillars=pillars,
        world=world,
    )


class Landmarks:
    """Ids (M,) and positions (M, 3)."""

    def __init__(self, id: np.ndarray, position_m: np.ndarray) -> None:
        self.id, self.position_m = id, position_m

    def __len__(self) -> int:
        return len(self.id)
