"""The bit rate follows the link: both ends' own code around a simulated bottleneck."""

from __future__ import annotations

import statistics

import pytest
from bottleneck import Flown, fly
from impaired_link import Impairment

from pi_firmware.settings import EncoderSettings

QUEUE_S = 0.5
WIDE = EncoderSettings(bitrate_kbps=6000, min_bitrate_kbps=50)
USUAL = EncoderSettings()


def narrow(kbps: float) -> Impairment:
    return Impairment(rate_kbps=kbps, queue_s=QUEUE_S)


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[int(share * (len(values) - 1))]


def first(flown: Flown, from_s: float, low_kbps: float, high_kbps: float) -> float:
    """How long after `from_s` the bit rate asked for is first between these."""
    times = zip(flown.at_s, flown.asked_kbps, strict=True)
    return next(at - from_s for at, kbps in times if at >= from_s and low_kbps <= kbps <= high_kbps)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("link_kbps", [300, 500, 800, 1500, 2500, 5000])
def test_a_narrow_link_is_filled_within_seconds_and_its_queue_stays_short(
    link_kbps: int, seed: int
) -> None:
    flown = fly(WIDE, lambda _: narrow(link_kbps), 30.0, seed=seed)
    assert first(flown, 0.0, 0.7 * link_kbps, 0.95 * link_kbps) < 3.0
    asked = flown.between(3.0, 30.0, flown.asked_kbps)
    assert 0.8 * link_kbps < statistics.mean(asked) < link_kbps
    assert min(asked) > 0.65 * link_kbps and max(asked) < 1.1 * link_kbps
    queue_s = flown.between(3.0, 30.0, flown.queue_s)
    assert quantile(queue_s, 0.98) < 0.15 and max(queue_s) < 0.25
    assert sum(flown.between(3.0, 30.0, flown.lost)) == 0


def test_a_link_that_widens_is_used_within_ten_seconds_and_one_that_narrows_is_obeyed() -> None:
    def changes(at_s: float) -> Impairment:
        return narrow(2000 if 15.0 <= at_s < 35.0 else 800)

    flown = fly(WIDE, changes, 50.0)
    assert first(flown, 15.0, 1400, 2000) < 10.0
    assert first(flown, 35.0, 0, 760) < 2.0
    assert sum(flown.between(38.0, 50.0, flown.lost)) == 0


def test_single_losses_lower_nothing_however_few_packets_there_are() -> None:
    for settings in (USUAL, EncoderSettings(bitrate_kbps=300, min_bitrate_kbps=50)):
        flown = fly(settings, lambda _: Impairment(loss=0.05), 60.0, seed=3)
        assert min(flown.asked_kbps) == settings.bitrate_kbps
        assert sum(flown.lost) > 0.03 * sum(flown.sent)


def test_a_third_lost_for_long_lowers_it_without_any_queue() -> None:
    flown = fly(USUAL, lambda _: Impairment(loss=0.33), 12.0)
    assert flown.asked_kbps[-1] == USUAL.min_bitrate_kbps
    assert first(flown, 0.0, 0, 1999) > 2.0


@pytest.mark.parametrize("out_s", [0.3, 2.0, 8.0])
def test_an_outage_is_no_reason_to_send_less_after_it(out_s: float) -> None:
    def breaks(at_s: float) -> Impairment:
        return Impairment(loss=1.0 if 5.0 <= at_s < 5.0 + out_s else 0.0)

    assert min(fly(USUAL, breaks, 10.0 + out_s).asked_kbps) == USUAL.bitrate_kbps


@pytest.mark.parametrize("jitter_s", [0.02, 0.2])
def test_jitter_and_a_long_way_are_no_queue(jitter_s: float) -> None:
    far = Impairment(delay_s=0.4, jitter_s=jitter_s)
    assert min(fly(USUAL, lambda _: far, 20.0).asked_kbps) == USUAL.bitrate_kbps


def test_a_way_that_has_become_longer_costs_its_time_and_then_nothing() -> None:
    flown = fly(USUAL, lambda at_s: Impairment(delay_s=0.15 if at_s >= 10.0 else 0.0), 40.0)
    assert flown.asked_kbps[-1] == USUAL.bitrate_kbps
    assert first(flown, 14.0, 2000, 2000) < 20.0
    last = flown.reports[-1][1]
    assert last.queue_s is not None and last.queue_s < 0.01


def test_an_encoder_that_makes_more_than_asked_for_is_held_back_and_one_of_less_not_wound_up() -> (
    None
):
    more = fly(WIDE, lambda _: narrow(1000), 30.0, makes=1.3)
    queue_s = more.between(5.0, 30.0, more.queue_s)
    assert quantile(queue_s, 0.9) < 0.15 and sum(more.between(5.0, 30.0, more.lost)) == 0
    # Asked for less once, it makes a third; what it would do with more was not seen.
    less = fly(WIDE, lambda at_s: narrow(500 if at_s < 4.0 else 0), 40.0, makes=0.33)
    assert max(less.between(10.0, 40.0, less.asked_kbps)) < 3000


def test_reports_hurry_while_there_is_a_queue_and_take_their_time_without() -> None:
    flown = fly(WIDE, lambda _: narrow(1000), 3.0)
    times = [at_s for at_s, _ in flown.reports]
    assert times[0] < 0.6
    # Five a second of these, and those of each second.
    assert 5 <= len(times) <= 15 and times[1] - times[0] > 0.19
    calm = fly(USUAL, lambda _: Impairment(), 5.0)
    assert [round(at_s) for at_s, _ in calm.reports] == [1, 2, 3, 4]
