"""Words are learned that keep descriptors as near as their bytes allow."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.errors import MapError
from ground_station.map.descriptors import Descriptors, quantised
from ground_station.map_update.compression.codes import code, error, usual_bytes


def _rows(count=700, dimension=16, seed=5) -> np.ndarray:
    """Unit rows with the structure that descriptors have: neighbouring numbers go together."""
    rng = np.random.default_rng(seed)
    rows = np.abs(rng.normal(size=(count, dimension // 4)).repeat(4, axis=1))
    rows = rows * rng.uniform(0.7, 1.3, rows.shape)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def test_more_bytes_keep_them_nearer():
    rows = _rows()
    errors = [error(rows, code(rows, stretches, seed=0)) for stretches in (2, 4, 8, 16)]
    assert errors == sorted(errors, reverse=True)
    # A direction at random in 16 dimensions would be 1.4 away; a fifth of each number's own size.
    assert errors[0] < 0.3 and errors[-1] < 0.01


def test_what_repeats_is_kept_exactly():
    """No more than 256 different stretches: each is a word."""
    rng = np.random.default_rng(1)
    words = np.abs(rng.normal(size=(4, 30, 4)))
    pick = rng.integers(0, 30, (800, 4))
    rows = np.concatenate([words[s, pick[:, s]] for s in range(4)], axis=1).astype(np.float32)
    rows /= np.linalg.norm(rows[0])  # not unit rows, or the stretches would differ
    coded = code(rows, 4, seed=2)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    assert np.abs(coded[:] - unit).max() < 1e-3  # half precision


def test_words_are_the_best_for_what_they_stand_for():
    """No code could be exchanged for a nearer word, and no word moved to a better place."""
    rows = _rows()
    coded = code(rows, 4, seed=0)
    for s in range(4):
        part, book = rows[:, 4 * s : 4 * s + 4], coded.codebook[s].astype(np.float64)
        apart = ((part[:, None] - book[None]) ** 2).sum(axis=2)
        own = apart[np.arange(len(part)), coded.codes[:, s]]
        assert (own <= apart.min(axis=1) + 1e-6).all()
        means = np.array([part[coded.codes[:, s] == w].mean(axis=0) for w in range(len(book))])
        better = ((part - means[coded.codes[:, s]]) ** 2).sum()
        assert own.sum() < 1.02 * better


def test_the_seed_decides_and_nothing_else():
    rows = _rows(400)
    one, same, other = (code(rows, 4, seed) for seed in (7, 7, 8))
    assert np.array_equal(one.codes, same.codes) and np.array_equal(one.codebook, same.codebook)
    assert not np.array_equal(one.codes, other.codes)


def test_fewer_descriptors_than_words_are_borne():
    rows = _rows(5)
    coded = code(rows, 4, seed=0)
    assert coded.codebook.shape == (4, 5, 4) and error(rows, coded) < 1e-3
    same = np.repeat(rows[:1], 40, axis=0)
    assert error(same, code(same, 4, seed=0)) < 1e-3


def test_a_maps_own_descriptors_are_coded_as_they_come_out():
    rows = _rows(300)
    kept = Descriptors(quantised(rows)["descriptor_u8"])
    assert error(rows, code(kept, 8, seed=0)) < error(rows, code(rows, 8, seed=0)) + 0.01


@pytest.mark.parametrize(("numbers", "each"), [(128, 32), (256, 64), (6, 1), (10, 2), (1, 1)])
def test_a_byte_for_every_four_numbers_or_what_divides(numbers, each):
    assert usual_bytes(numbers) == each and numbers % each == 0
    assert usual_bytes(numbers, 8) <= each and numbers % usual_bytes(numbers, 8) == 0


@pytest.mark.parametrize("stretches", [0, 3, 17, 32])
def test_bytes_that_do_not_divide_a_descriptor_are_refused(stretches):
    with pytest.raises(MapError, match="of 16 numbers, allowed are 1, 2, 4, 8, 16"):
        code(_rows(10), stretches, seed=0)
