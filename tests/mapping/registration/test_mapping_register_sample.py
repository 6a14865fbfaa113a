"""Six known points with five centimetres of noise, in the map that ships: how far it is off then.

The map's own poses and observations, judged by the mapping flight's true poses; the points' places
are told with noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ground_station.map import store
from ground_station.map.levelling import transformed
from ground_station.map.uncertainty import describe
from ground_station.mapping.registration.observations import PointObservations, read_pairs
from ground_station.mapping.registration.register import by_observations
from ground_station.recording.flight import trajectory_of

SAMPLE = Path(__file__).parents[3] / "maps" / "atrium"
NOISE_M = 0.05
DRAWS = 20


@pytest.fixture(scope="module")
def sample():
    """The map, its keyframes' true places (K, 3), and the shipped observations."""
    map_, truth = store.load(SAMPLE), trajectory_of(SAMPLE / "mapping.mcap")
    at = [truth.nearest(int(t)) for t in map_.keyframes.time_ns]
    return map_, truth.position_m[at], read_pairs(SAMPLE / "PAIRS.csv")


@pytest.fixture(scope="module")
def six(sample) -> PointObservations:
    """Of points that a person would survey: each the farthest from those before."""
    observations = sample[2]
    places = observations.world_m
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < 6:
        gaps = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1)
        chosen.append(int(np.argmax(gaps)))
    chosen.sort()
    kept = np.flatnonzero(np.isin(observations.point, chosen))
    return PointObservations(
        [observations.points[p] for p in chosen],
        places[chosen],
        np.searchsorted(chosen, observations.point[kept]),
        [observations.image[k] for k in kept],
        observations.pixel_px[kept],
    )


def off_m(found, map_, truth_m) -> np.ndarray:
    return np.linalg.norm(found.fit.apply(map_.keyframes.wTc[:, :3, 3]) - truth_m, axis=1)


def test_six_points_with_five_centimetres_of_noise(sample, six):
    map_, truth_m, _ = sample
    rng = np.random.default_rng(0)
    median_m, covered, points = [], [], []
    for _ in range(DRAWS):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        found = by_observations(map_, dataclasses.replace(six, world_m=told), 0)
        off = off_m(found, map_, truth_m)
        median_m.append(np.median(off))
        covered.append(np.mean(off <= found.uncertainty.radius_m(truth_m)))
        points.append(found.report["points"])
    assert np.median(median_m) < 0.06, median_m
    assert np.sum(np.equal(points, 6)) >= 19  # one in a hundred is left out by chance
    assert np.mean(covered) >= 0.85, covered


def test_one_of_six_that_is_three_metres_off_is_named(sample, six):
    map_, truth_m, _ = sample
    rng = np.random.default_rng(1)
    for wrong in range(6):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        told[wrong] += 3 * np.array([0.6, -0.8, 0.0])
        found = by_observations(map_, dataclasses.replace(six, world_m=told), 0)
        assert found.report["points"] == 5
        assert f"point '{six.points[wrong]}' left out" in found.notes[0]
        assert np.median(off_m(found, map_, truth_m)) < 0.15


def test_the_uncertainty_of_the_shipped_observations_is_centimetres(sample):
    map_, _, observations = sample
    found = by_observations(map_, observations, 0)
    moved = transformed(map_, found.fit)
    report = describe(found.uncertainty, moved.landmarks.position_m)
    assert report["centre_90_percent_m"] < 0.01 and report["corner_90_percent_m"] < 0.03
    assert report["scale_sigma_percent"] < 0.1
