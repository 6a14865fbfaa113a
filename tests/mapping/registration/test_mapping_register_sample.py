"""Six known points with five centimetres of noise, in the map that ships: how far it is off then.

The map's own poses and observations, judged by the mapping flight's true poses; the points' places
are told with noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from surveyed_points import NOISE_M, far_apart, only, six_points

from ground_station.map import store
from ground_station.map.levelling import transformed
from ground_station.map.uncertainty import describe
from ground_station.mapping.registration.observations import read_pairs
from ground_station.mapping.registration.register import by_observations
from ground_station.recording.flight import trajectory_of

SAMPLE = Path(__file__).parents[3] / "maps" / "atrium"
DRAWS = 20


@pytest.fixture(scope="module")
def sample():
    map_, truth = store.load(SAMPLE), trajectory_of(SAMPLE / "mapping.mcap")
    at = [truth.nearest(int(t)) for t in map_.keyframes.time_ns]
    return map_, truth.position_m[at], read_pairs(SAMPLE / "PAIRS.csv")


def test_six_points_with_five_centimetres_of_noise(sample):
    map_, truth_m, observations = sample
    drawn = six_points(map_, truth_m, observations, DRAWS)
    assert np.median(drawn.median_m) < 0.06, drawn.median_m
    assert np.sum(np.equal(drawn.points, 6)) >= 19  # one in a hundred is left out by chance
    assert np.mean(drawn.covered) >= 0.85, drawn.covered


def test_one_of_six_that_is_three_metres_off_is_named(sample):
    map_, truth_m, observations = sample
    six = only(observations, far_apart(observations.world_m, 6))
    rng = np.random.default_rng(1)
    for wrong in range(6):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        told[wrong] += 3 * np.array([0.6, -0.8, 0.0])
        found = by_observations(map_, dataclasses.replace(six, world_m=told), 0)
        assert found.report["points"] == 5
        assert f"point '{six.points[wrong]}' left out" in found.notes[0]
        off = np.linalg.norm(found.fit.apply(map_.keyframes.wTc[:, :3, 3]) - truth_m, axis=1)
        assert np.median(off) < 0.15


def test_the_uncertainty_of_the_shipped_observations_is_centimetres(sample):
    map_, _, observations = sample
    found = by_observations(map_, observations, 0)
    moved = transformed(map_, found.fit)
    report = describe(found.uncertainty, moved.landmarks.position_m)
    assert report["centre_90_percent_m"] < 0.01 and report["corner_90_percent_m"] < 0.03
    assert report["scale_sigma_percent"] < 0.1
