"""Six known points with five centimetres of noise, in the map that ships: how far it is off then.

The map's own poses and sights, judged by the mapping flight's true poses; the points' places are
told with noise.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from ground_station.mapping import store
from ground_station.mapping.registration.from_sights import by_sights
from ground_station.mapping.registration.register import transform_map
from ground_station.mapping.registration.sights import Sights, read_pairs
from ground_station.mapping.registration.uncertainty import describe
from ground_station.recording.flight import trajectory_of

SAMPLE = Path(__file__).parents[3] / "maps" / "atrium"
NOISE_M = 0.05
DRAWS = 20


def only(sights: Sights, chosen: list[int]) -> Sights:
    """The sights of some of the points."""
    kept = np.flatnonzero(np.isin(sights.point, chosen))
    place = {p: k for k, p in enumerate(chosen)}
    return Sights(
        [sights.points[p] for p in chosen],
        sights.world_m[chosen],
        np.array([place[p] for p in sights.point[kept].tolist()]),
        [sights.image[k] for k in kept],
        sights.pixel_px[kept],
    )


def far_apart(places: np.ndarray, count: int) -> list[int]:
    """Points that a person would survey: each the farthest from those before."""
    chosen = [int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        gaps = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1)
        chosen.append(int(np.argmax(gaps)))
    return sorted(chosen)


@pytest.fixture(scope="module")
def sample():
    map_, truth = store.load(SAMPLE), trajectory_of(SAMPLE / "mapping.mcap")
    at = [truth.nearest(int(t)) for t in map_.keyframes.time_ns]
    return map_, truth.position_m[at], read_pairs(SAMPLE / "PAIRS.csv")


def test_six_points_with_five_centimetres_of_noise(sample):
    map_, truth_m, sights = sample
    six = only(sights, far_apart(sights.world_m, 6))
    rng = np.random.default_rng(0)
    medians, covered, points = [], [], []
    for _ in range(DRAWS):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        found = by_sights(map_, dataclasses.replace(six, world_m=told), 0)
        points.append(found.report["points"])
        off = np.linalg.norm(found.fit.apply(map_.keyframes.wTc[:, :3, 3]) - truth_m, axis=1)
        medians.append(np.median(off))
        covered.append(np.mean(off <= found.uncertainty.radius_m(truth_m)))
    assert np.median(medians) < 0.06, medians
    assert np.sum(np.equal(points, 6)) >= 19  # a point is left out by chance in one of a hundred
    assert np.mean(covered) >= 0.85, covered


def test_one_of_six_that_is_three_metres_off_is_named(sample):
    map_, truth_m, sights = sample
    six = only(sights, far_apart(sights.world_m, 6))
    rng = np.random.default_rng(1)
    for wrong in range(6):
        told = six.world_m + NOISE_M * rng.normal(size=six.world_m.shape)
        told[wrong] += 3 * np.array([0.6, -0.8, 0.0])
        found = by_sights(map_, dataclasses.replace(six, world_m=told), 0)
        assert found.report["points"] == 5
        assert f"point '{six.points[wrong]}' left out" in found.notes[0]
        off = np.linalg.norm(found.fit.apply(map_.keyframes.wTc[:, :3, 3]) - truth_m, axis=1)
        assert np.median(off) < 0.15


def test_the_uncertainty_of_the_shipped_sights_is_centimetres(sample):
    map_, _, sights = sample
    found = by_sights(map_, sights, 0)
    moved = transform_map(map_, found.fit)
    report = describe(found.uncertainty, moved.landmarks.position_m)
    assert report["centre_90_percent_m"] < 0.01 and report["corner_90_percent_m"] < 0.03
    assert report["scale_sigma_percent"] < 0.1
