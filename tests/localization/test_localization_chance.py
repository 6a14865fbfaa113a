"""How much of what is paired chance may have paired."""

import numpy as np
import pytest

from ground_station.localization.matching import count_beyond_chance


def test_pairs_are_kept_until_chance_made_too_many_of_them():
    distance = np.linspace(0.1, 0.7, 100)
    by_chance = [0.15, 0.6, 0.61, 0.62, 0.63, 0.64, 0.65]
    count = count_beyond_chance(distance, np.array(by_chance), 0.05)
    assert (np.array(by_chance) <= distance[count - 1]).sum() <= 0.05 * count
    assert 0.62 < distance[count - 1] < 0.63
    # Of the first ten one is a tenth; it ends nothing, as there is enough beyond.
    assert count_beyond_chance(distance[:10], np.array(by_chance), 0.05) == 9


def test_where_all_is_chance_next_to_nothing_is_kept():
    random = np.random.default_rng(0)
    found, by_chance = np.sort(random.uniform(0.4, 0.7, 200)), random.uniform(0.4, 0.7, 200)
    assert count_beyond_chance(found, by_chance, 0.05) < 20


@pytest.mark.parametrize("by_chance", [[], [0.9, 0.8]])
def test_where_nothing_is_chance_all_is_kept(by_chance):
    assert count_beyond_chance(np.array([0.1, 0.5]), np.array(by_chance), 0.05) == 2


def test_of_nothing_nothing_is_kept():
    assert count_beyond_chance(np.array([]), np.array([0.3]), 0.05) == 0
