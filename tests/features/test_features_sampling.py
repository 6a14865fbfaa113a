"""Descriptors are read from a network's map as the papers do, reckoned in plain loops beside."""

from __future__ import annotations

import numpy as np
import pytest
from reference import plain_alike, plain_superpoint

from ground_station.features import sampling


@pytest.fixture
def table():
    return np.random.default_rng(0).normal(size=(24, 7, 9)).astype(np.float32)


def test_cells_are_interpolated_bicubically_and_beyond_the_edge_go_on(table):
    rng = np.random.default_rng(1)
    inside = rng.uniform([0, 0], [8, 6], (40, 2))
    edges = np.array([[-0.4375, -0.4375], [8.4, 6.4], [0, 6.4375], [8, 0], [3, 2]])
    at = np.concatenate([inside, edges]).astype(np.float32)
    found = sampling.bicubic(table, at)
    expected = [plain_superpoint.descriptor(table.astype(float), x, y) for x, y in at.tolist()]
    assert found.shape == (45, 24) and found.dtype == np.float32
    assert np.allclose(found, expected, atol=2e-5)
    assert np.allclose(found[-1], table[:, 2, 3], atol=1e-6)


def test_pixels_are_interpolated_bilinearly(table):
    at = np.random.default_rng(2).uniform([0, 0], [7.99, 5.99], (40, 2)).astype(np.float32)
    found = sampling.bilinear(table, at)
    expected = [plain_alike.descriptor(table.astype(float), x, y) for x, y in at.tolist()]
    assert np.allclose(found, expected, atol=1e-5)
    corner = sampling.bilinear(table, np.array([[8, 6], [0, 0], [99, -5]], np.float32))
    assert np.allclose(corner, [table[:, 6, 8], table[:, 0, 0], table[:, 0, 8]], atol=1e-6)


def test_no_key_points_give_no_descriptors(table):
    none = np.empty((0, 2), np.float32)
    for sample in (sampling.bicubic, sampling.bilinear):
        assert sample(table, none).shape == (0, 24)


def test_vectors_are_brought_to_unit_length_and_those_that_have_none_are_named():
    rows = np.array([[3, 4], [0, 0], [np.nan, 1], [np.inf, 1], [0, -2]], np.float32)
    vectors, good = sampling.unit(rows)
    assert good.tolist() == [True, False, False, False, True]
    assert np.allclose(vectors[good], [[0.6, 0.8], [0, -1]])
    assert vectors.dtype == np.float32
