"""The search for a limit: against made-up systems whose limit is known, also odd ones."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from limits_axes import BORNE, Found, Tried, search


class System:
    """Bears the levels of which `bears` is true, and says how often it was asked for each."""

    def __init__(self, bears: Callable[[int], bool]) -> None:
        self._bears = bears
        self.asked: list[int] = []

    def __call__(self, level: int) -> list[float]:
        self.asked.append(level)
        return [0.99, 0.96] if self._bears(level) else [0.99, 0.94]


@pytest.mark.parametrize("levels", [1, 2, 3, 9, 13])
def test_the_limit_is_found_wherever_it_lies_and_with_few_trials(levels: int) -> None:
    for limit in range(-1, levels):
        system = System(lambda level, limit=limit: level <= limit)
        found = search(levels, system, Found())
        assert found.sustained == (limit if limit >= 0 else None)
        assert found.refused == (limit + 1 if limit + 1 < levels else None)
        assert found.odd == []
        assert len(system.asked) == len(set(system.asked)) <= 3 + math.ceil(math.log2(levels + 1))


def test_both_neighbours_of_a_limit_are_tried() -> None:
    found = search(13, System(lambda level: level <= 6), Found())
    assert {0, 5, 6, 7, 8} <= set(found.tried)


def test_when_nothing_is_borne_without_a_burden_nothing_more_is_tried() -> None:
    system = System(lambda level: False)
    found = search(9, system, Found())
    assert system.asked == [0] and found.sustained is None and found.refused == 0


def test_a_level_that_is_borne_again_beyond_is_told_and_not_taken_for_the_limit() -> None:
    found = search(9, System(lambda level: level != 5), Found())
    assert (found.sustained, found.refused) in ((4, 5), (8, None))
    found = search(9, System(lambda level: level < 4 or level == 5), Found())
    assert (found.sustained, found.refused, found.odd) == (3, 4, [5])


def test_a_hole_below_the_limit_lowers_it() -> None:
    """Bisecting lands on 6; only the look at the level below finds the hole."""
    found = search(13, System(lambda level: level <= 6 and level != 5), Found())
    assert (found.sustained, found.refused) == (4, 5)
    assert 6 in found.odd


def test_what_is_known_is_not_measured_again_and_an_interruption_keeps_it() -> None:
    calls: list[int] = []

    def stops(level: int) -> list[float]:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(level)
        return [1.0] if level <= 2 else [0.0]

    found = Found()
    with pytest.raises(KeyboardInterrupt):
        search(13, stops, found)
    assert sorted(found.tried) == sorted(calls) and len(calls) == 3
    system = System(lambda level: level <= 2)
    search(13, system, found)
    assert found.sustained == 2 and not set(system.asked) & set(calls)


@pytest.mark.parametrize(
    ("shares", "sustained"),
    [
        ((BORNE,), True),
        ((0.99, 0.9499, 0.99), False),
        ((0.99, float("nan")), False),
        ((), False),
    ],
)
def test_each_seed_must_keep_the_share(shares: tuple[float, ...], sustained: bool) -> None:
    assert Tried(shares).sustained is sustained


def test_noise_near_the_limit_cannot_make_the_answer_contradict_itself() -> None:
    """Whatever the trials say: all tried up to `sustained` are sustained, and `refused` is not."""
    import random

    for seed in range(300):
        draw = random.Random(seed)
        found = search(11, System(lambda level, draw=draw: draw.random() > level / 10), Found())
        tried = found.tried
        if found.sustained is not None:
            assert all(one.sustained for n, one in tried.items() if n <= found.sustained)
        if found.refused is not None:
            assert not tried[found.refused].sustained
            assert found.sustained is None or found.sustained < found.refused
            if not found.odd and found.sustained is not None:
                assert found.refused == found.sustained + 1
