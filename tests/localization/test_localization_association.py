"""Association on bands and chunks finds what comparing everything with everything finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import all_compared, unit, unit_rows

from ground_station.localization.association import associate
from ground_station.localization.settings import AssociationSettings


def _pairs(found):
    return list(zip(found.feature.tolist(), found.candidate.tolist(), strict=True))


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    features=st.integers(1, 120),
    landmarks=st.integers(1, 200),
    dimension=st.sampled_from([16, 128, 256]),
    radius=st.sampled_from([3.0, 40.0, 150.0, 2000.0]),
    ratio=st.sampled_from([1.0, 0.9, 0.5]),
    lean=st.sampled_from([0.0, 1.0]),
    each_its_own=st.booleans(),
)
def test_the_pairs_are_those_of_all_distances(
    seed, features, landmarks, dimension, radius, ratio, lean, each_its_own
):
    rng = np.random.default_rng(seed)
    lp = rng.uniform(-100, 700, (landmarks, 2))
    # Some features have no landmark at all; some landmarks are wanted by several features.
    ld = unit(rng.normal(size=(landmarks, dimension)) + lean)
    own = rng.integers(0, landmarks, features)
    fp = lp[own] + rng.normal(0, 0.5 * radius, (features, 2))
    fd = unit(ld[own] + rng.normal(0, 0.5 / np.sqrt(dimension), (features, dimension)))
    options, limit = AssociationSettings(max_ratio=ratio), None
    if each_its_own:
        radius, limit = rng.uniform(0, 2 * radius, landmarks), rng.uniform(0.2, 1.0)
        radius[::9] = np.nan
    found = associate(fp, fd, lp, ld, options, radius, limit)
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(fp[:, None] - lp[None], axis=2) <= radius
    distance = np.linalg.norm(fd[:, None].astype(float) - ld[None], axis=2)
    limit = options.max_descriptor_distance if limit is None else limit
    assert _pairs(found) == all_compared(distance, near, limit, ratio)
    apart = np.linalg.norm(fd[found.feature] - ld[found.candidate], axis=1)
    assert np.allclose(found.distance, apart, atol=1e-5)


@pytest.mark.parametrize("dimension", [32, 256])
def test_of_equal_landmarks_the_first_is_taken_and_none_stands_out(dimension):
    rng = np.random.default_rng(5)
    row = unit_rows(rng, 1, dimension)
    lp = np.array([[300.0, 200.0], [310.0, 210.0], [290.0, 190.0], [600.0, 20.0]])
    ld = np.repeat(row, 4, axis=0)
    fp, fd = np.array([[301.0, 201.0]]), row.copy()
    assert _pairs(associate(fp, fd, lp, ld, AssociationSettings())) == [(0, 0)]
    assert _pairs(associate(fp, fd, lp[::-1], ld, AssociationSettings())) == [(0, 1)]
    assert len(associate(fp, fd + 0.01, lp, ld, AssociationSettings(max_ratio=0.9))) == 0


def test_of_equal_features_the_first_keeps_the_landmark():
    rng = np.random.default_rng(6)
    row = unit_rows(rng, 1, 256)
    fp, fd = np.array([[10.0, 10.0], [20.0, 90.0], [0.0, 0.0]]), np.repeat(row, 3, axis=0)
    found = associate(fp, fd, np.array([[12.0, 40.0]]), row, AssociationSettings(), 100.0)
    assert _pairs(found) == [(0, 0)]


def test_a_landmark_at_the_radius_is_within_it_and_one_beyond_is_not():
    row = np.eye(1, 8, dtype=np.float32)
    at, beyond = np.array([[40.0, 0.0]]), np.array([[40.0 + 1e-9, 0.0]])
    assert len(associate(np.zeros((1, 2)), row, at, row, AssociationSettings(), 40.0)) == 1
    assert len(associate(np.zeros((1, 2)), row, beyond, row, AssociationSettings(), 40.0)) == 0


def test_nothing_near_and_nothing_alike_are_no_pairs():
    rows = np.eye(2, 200, dtype=np.float32)
    here, there = np.zeros((1, 2)), np.full((1, 2), 400.0)
    assert len(associate(here, rows[:1], there, rows[:1], AssociationSettings())) == 0
    assert len(associate(here, rows[:1], here, rows[1:], AssociationSettings())) == 0


def test_landmarks_without_a_usable_radius_are_not_paired():
    rows, here = np.eye(2, 8, dtype=np.float32), np.zeros((2, 2))
    nothing = np.full(2, np.nan)
    options = AssociationSettings()
    assert len(associate(here, rows, here, rows, options)) == 2
    assert len(associate(here, rows, here, rows, options, nothing)) == 0
    assert len(associate(here, rows, here, rows, options, np.array([5.0, -5.0]))) == 1
