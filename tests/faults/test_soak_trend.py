"""The slope of a long run: what leaks is caught, noise is not, and a short run says so."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from soaking.judging import FALLS, FLAT, GROWS, SHORT, SMALL, row, verdict
from soaking.measures import CLOCK, DESCRIPTORS, MEMORY, Measure, from_document
from soaking.trend import Trend, trend

Array = npt.NDArray[np.float64]
EVERY_S = 10.0
HALF_HOUR, HOUR = 180, 360


def series(values: Array) -> Array:
    return np.column_stack([EVERY_S * np.arange(len(values)), values])


def noise(n: int, memory: float = 0.0, size: float = 1.0, seed: int = 1) -> Array:
    """Of unit variance times `size`, each value keeping the share `memory` of the one before."""
    draw = np.random.default_rng(seed)
    values = np.empty(n)
    last = draw.normal()
    for k in range(n):
        last = memory * last + math.sqrt(1 - memory**2) * draw.normal()
        values[k] = last
    return size * values


def ramp(n: int, per_hour: float) -> Array:
    return per_hour * EVERY_S / 3600 * np.arange(n)


def word(values: Array, matters: float, *, both: bool = False, step: float = 0.0) -> str:
    found, holds = verdict(trend(series(values), step), matters, both=both)
    assert holds == (found in (FLAT, SMALL))
    return found


def measure(values: Array, **more: float) -> Measure:
    points = [(float(t), float(v)) for t, v in series(values)]
    return Measure(MEMORY, "payload", "MB", points=points, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_a_leak_is_caught_and_its_size_told(memory: float) -> None:
    for seed in range(5):
        values = 80 + ramp(HOUR, 2.0) + noise(HOUR, memory, 0.1, seed)
        found = trend(series(values))
        assert found.low <= 2.0 <= found.high and found.low > 1.0
        assert word(values, matters=1.0) == GROWS


def test_a_leak_is_caught_under_spikes_that_a_mean_would_follow() -> None:
    spikes = np.random.default_rng(3).random(HOUR) < 0.1
    values = 80 + ramp(HOUR, 2.0) + noise(HOUR, 0.0, 0.1) + 50 * spikes
    assert word(values, matters=1.0) == GROWS


def test_what_a_leak_saves_up_in_steps_is_caught() -> None:
    """An allocator takes a MB at a time."""
    values = 80 + np.floor(ramp(4 * HOUR, 2.0)) + noise(4 * HOUR, 0.0, 0.05)
    assert word(values, matters=1.0) == GROWS


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_interval_holds_the_slope_in_most_of_many_runs(memory: float) -> None:
    held = 0
    for seed in range(60):
        found = trend(series(ramp(HALF_HOUR, 1.0) + noise(HALF_HOUR, memory, 1.0, seed)))
        held += found.low <= 1.0 <= found.high
    assert held >= 50  # 57 are promised


def test_values_that_hang_together_tell_less() -> None:
    free, bound = (trend(series(noise(HOUR, memory))) for memory in (0.0, 0.97))
    assert bound.effective < 0.5 * free.effective
    assert bound.high - bound.low > 3 * (free.high - free.low)


def test_noise_is_flat_where_the_run_is_long_enough_and_too_short_where_not() -> None:
    values = noise(HOUR, 0.5, 0.3)
    assert word(values, matters=1.0) == FLAT
    assert word(values[: HOUR // 6], matters=1.0) == SHORT
    assert word(10 * values, matters=1.0) == SHORT


def test_a_constant_is_flat() -> None:
    assert word(np.full(HOUR, 80.0), matters=0.1) == FLAT


def test_one_step_in_the_middle_is_not_told_from_a_leak() -> None:
    values = 80 + 2.0 * (np.arange(HOUR) > HOUR / 2) + noise(HOUR, 0.0, 0.05)
    assert word(values, matters=1.0) == SHORT


def test_what_creeps_a_little_is_told_from_a_leak_that_matters() -> None:
    """Pools that fill: 0.3 MB in an hour, each sample hanging on the one before."""
    values = 33 + 0.3 * (1 - np.exp(-np.arange(HOUR) / 100)) + noise(HOUR, 0.0, 0.001)
    assert word(values, matters=1.0) in (FLAT, SMALL)
    assert word(10 * values, matters=1.0) in (SHORT, GROWS)


def test_a_walk_without_aim_is_mostly_no_leak() -> None:
    held = 0
    for seed in range(40):
        found = trend(series(np.cumsum(noise(HALF_HOUR, 0.0, 1.0, seed))))
        held += found.low <= 0.0 <= found.high and math.isfinite(found.high)
    assert held >= 28


def test_one_step_early_in_a_long_run_is_forgiven() -> None:
    values = 80 + 2.0 * (np.arange(20 * HOUR) > HOUR) + noise(20 * HOUR, 0.0, 0.05)
    assert word(values, matters=1.0) == FLAT


def test_a_small_slope_that_is_surely_harmless_holds_by_another_word() -> None:
    values = 80 + ramp(4 * HOUR, 0.3) + noise(4 * HOUR, 0.0, 0.1)
    assert word(values, matters=1.0) == SMALL


def test_falling_matters_for_a_clock_and_not_for_memory() -> None:
    values = ramp(HOUR, -5.0) + noise(HOUR, 0.0, 0.1)
    assert word(values, matters=1.0) == SMALL
    assert word(values, matters=1.0, both=True) == FALLS


def test_a_counter_that_has_not_ticked_may_still_leak_slowly() -> None:
    """In half an hour one descriptor an hour shows no step in more than half of the runs."""
    values = np.full(HALF_HOUR, 37.0)
    assert word(values, matters=1.0, step=1.0) == SHORT
    assert word(values, matters=8.0, step=1.0) == FLAT
    assert word(np.full(4 * HOUR, 37.0), matters=1.0, step=1.0) == FLAT
    assert word(37 + np.floor(ramp(HOUR, 20.0)), matters=8.0, step=1.0) == GROWS


@pytest.mark.parametrize("n", [0, 1, 11])
def test_of_few_samples_nothing_is_told(n: int) -> None:
    found = trend(series(ramp(n, 100.0)))
    assert (found.low, found.high) == (-math.inf, math.inf)
    assert verdict(found, 1.0) == (SHORT, False)


def test_samples_that_are_missing_or_before_it_settled_do_not_count() -> None:
    one = measure(80 + noise(HOUR, 0.0, 0.1), matters=1.0)
    one.points[:60] = [(at_s, 500 - at_s) for at_s, _ in one.points[:60]]
    one.add(1e4, None)
    one.add(1e4 + 10, math.nan)
    settled = one.settled(600.0)
    assert len(settled) == HOUR - 60 and np.isfinite(settled).all()
    found = row(one, 600.0)
    assert found is not None and found.holds and FLAT in found.value
    assert found.bound == "1 MB/h"


def test_a_measure_of_nothing_but_missing_values_does_not_hold() -> None:
    found = row(measure(np.full(HOUR, math.nan), matters=1.0), 0.0)
    assert found is not None and not found.holds and SHORT in found.value


def test_what_has_no_bound_is_not_judged() -> None:
    assert row(measure(ramp(HOUR, 100.0)), 0.0) is None


def test_an_infinite_or_unknown_interval_never_holds() -> None:
    for low, high in ((-math.inf, math.inf), (math.nan, math.nan), (0.1, math.inf)):
        found = Trend(0.2, low, high, 0.0, 0.0, 1.0, 9.0)
        for both in (False, True):
            assert not verdict(found, 1.0, both=both)[1]


def test_a_measure_comes_back_from_its_file_with_its_gaps() -> None:
    one = Measure(DESCRIPTORS, "payload", "files", 8.0, step=1.0)
    one.add(0.0, 5.0)
    one.add(10.0, None)
    document = one.document()
    document["points"] = [[0.0, 5.0], [10.0, None]]  # as JSON has it
    again = from_document(document)
    assert again.points[0] == (0.0, 5.0) and math.isnan(again.points[1][1])
    assert (again.kind, again.matters, again.step, again.both) == (DESCRIPTORS, 8.0, 1.0, False)
    assert again.kind != CLOCK
