"""Six surveyed points, told with noise, register a map: how far it is off, and how sure it says."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ground_station.map.store import Map
from ground_station.mapping.registration.observations import PointObservations
from ground_station.mapping.registration.register import by_observations

NOISE_M = 0.05


@dataclass(frozen=True)
class Drawn:
    """Of each draw: the median distance (D,) of the map's keyframes to their true places, m; the
    share (D,) of them that lie within their printed 90 % radius; the points (D,) that were used."""

    median_m: list[float]
    covered: list[float]
    points: list[int]


def six_points(
    map_: Map, truth_m: np.ndarray, observations: PointObservations, draws: int
) -> Drawn:
    """Registers a map by six points far apart, `draws` times with other noise of `NOISE_M`.

    `truth_m` (K, 3): the keyframes' true places. Only the points' places are noisy, each coordinate
    on its own; the observations are those given.
    """
    six = only(observations, far_apart(observations.world_m, 6))
    rng = np.random.default_rng(0)
    drawn = Drawn([], [], [])
    for _ in range(draws):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        found = by_observations(map_, dataclasses.replace(six, world_m=told), 0)
        off = np.linalg.norm(found.fit.apply(map_.keyframes.wTc[:, :3, 3]) - truth_m, axis=1)
        drawn.median_m.append(float(np.median(off)))
        drawn.covered.append(float(np.mean(off <= found.uncertainty.radius_m(truth_m))))
        drawn.points.append(found.report["points"])
    return drawn


def only(observations: PointObservations, chosen: list[int]) -> PointObservations:
    """The observations of some of the points."""
    kept = np.flatnonzero(np.isin(observations.point, chosen))
    place = {p: k for k, p in enumerate(chosen)}
    return PointObservations(
        [observations.points[p] for p in chosen],
        observations.world_m[chosen],
        np.array([place[p] for p in observations.point[kept].tolist()]),
        [observations.image[k] for k in kept],
        observations.pixel_px[kept],
    )


def far_apart(places: np.ndarray, count: int) -> list[int]:
    """Points that a person would survey: each the farthest from those before."""
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        gaps = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1)
        chosen.append(int(np.argmax(gaps)))
    return sorted(chosen)
