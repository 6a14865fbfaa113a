"""What the payload makes of a ground station's reports, an older one's among them."""

from __future__ import annotations

import math

import pytest

from pi_firmware.encoder import Adaptation
from pi_firmware.settings import EncoderSettings
from pi_firmware.wire.messages import LinkReport

LIMITS = EncoderSettings(bitrate_kbps=2000, min_bitrate_kbps=300, gop_frames=15, min_gop_frames=10)


def told(lost: float = 0.0, round_trip_s: float | None = 0.02, **seen: float | None) -> LinkReport:
    values = {"lost": lost, "round_trip_s": round_trip_s, **seen}
    return LinkReport(1, "main", 5600, **values)  # type: ignore[arg-type]


def flows(received_kbps: float, queue_s: float | None = 0.0, dropped: float = 0.0) -> LinkReport:
    return told(received_kbps=received_kbps, queue_s=queue_s, dropped=dropped)


def after(*reports: LinkReport, every_s: float = 1.0, kbps: float = 2000) -> Adaptation:
    adaptation = Adaptation(LIMITS)
    adaptation.bitrate_kbps = kbps
    for number, report in enumerate(reports):
        adaptation.report(report, 100.0 + number * every_s)
    return adaptation


def test_an_older_grounds_good_link_keeps_the_configured_rate_and_the_longest_interval() -> None:
    adaptation = after(*[told()] * 20)
    assert (adaptation.bitrate_kbps, adaptation.gop_frames) == (2000, 15)


def test_an_older_grounds_losses_lower_the_rate_to_its_bound_and_a_good_link_raises_it() -> None:
    assert after(told(0.2)).bitrate_kbps == pytest.approx(1800)
    assert after(told(0.2), told(0.05)).bitrate_kbps == pytest.approx(1800)
    low = after(*[told(0.5)] * 60)
    assert low.bitrate_kbps == 300
    low.report(told(), 200.0)
    assert low.bitrate_kbps == pytest.approx(315)


def test_an_older_grounds_long_round_trip_lowers_the_rate_without_any_loss() -> None:
    assert after(told(round_trip_s=0.5)).bitrate_kbps == pytest.approx(1700)
    assert after(told(round_trip_s=None)).bitrate_kbps == 2000
    # Where the queue is measured, a long way is none.
    far = LinkReport(1, "main", 5600, round_trip_s=0.9, received_kbps=2e3, queue_s=0.0, dropped=0.0)
    assert after(*[far] * 5).bitrate_kbps == 2000


@pytest.mark.parametrize(("lost", "frames"), [(0.0, 15), (0.02, 13), (0.05, 10), (0.9, 10)])
def test_the_more_is_lost_the_sooner_comes_an_idr(lost: float, frames: int) -> None:
    assert after(told(lost)).gop_frames == frames


def test_a_queue_lowers_the_rate_below_what_came_and_to_that_once_it_has_drained() -> None:
    lowered = after(flows(1500, 0.2))
    assert lowered.bitrate_kbps == pytest.approx(0.85 * 1500 * 0.8)
    lowered.report(flows(1500, 0.1), 100.2)
    assert lowered.bitrate_kbps == pytest.approx(0.85 * 1500 * 0.9)
    lowered.report(flows(1300, 0.0), 100.4)
    assert lowered.bitrate_kbps == pytest.approx(0.85 * 1500)


def test_a_queue_is_judged_again_only_after_a_moment_and_only_if_it_stays() -> None:
    at_once = after(flows(1500, 0.2), flows(1000, 0.2), every_s=0.1)
    assert at_once.bitrate_kbps == pytest.approx(0.85 * 1500 * 0.8)
    stays = after(flows(1500, 0.2), flows(1000, 0.2), every_s=0.4)
    assert stays.bitrate_kbps == pytest.approx(0.85 * 1000 * 0.8)
    drains = after(flows(1500, 0.2), flows(1000, 0.12), every_s=0.4)
    assert drains.bitrate_kbps == pytest.approx(0.85 * 1500 * 0.88)


def test_what_is_lost_beside_a_queue_is_overflow_and_without_one_only_after_a_while() -> None:
    assert after(flows(1500, 0.04, 0.2)).bitrate_kbps < 1300
    alone = [flows(1500, 0.0, 0.2)] * 3
    assert after(*alone[:2]).bitrate_kbps == 2000
    assert after(*alone).bitrate_kbps == pytest.approx(0.85 * 1500)
    assert after(*[flows(1800, 0.0, 0.08)] * 50).bitrate_kbps == 2000


def test_a_good_link_raises_it_faster_far_from_where_it_was_full() -> None:
    free = after(*[flows(900)] * 2, kbps=1000)
    assert free.bitrate_kbps == pytest.approx(1200)
    near = after(flows(1000, 0.2), *[flows(850)] * 2, kbps=1000)
    assert near.bitrate_kbps < 1.12 * 850
    assert after(*[flows(900)] * 30, kbps=1000).bitrate_kbps == pytest.approx(1.5 * 900 + 50)
    assert after(*[flows(300)] * 30, kbps=1000).bitrate_kbps == 1000  # not wound up, nor lowered


def test_where_nothing_comes_nothing_is_learned() -> None:
    gone = LinkReport(1, "main", 5600, lost=1.0, received_kbps=0.0, queue_s=None, dropped=0.0)
    assert after(*[gone] * 20).bitrate_kbps == 2000
    stale = after(*[flows(800, 0.4, 0.3)] * 20, every_s=0.001)  # all at once, after an outage
    assert stale.bitrate_kbps == after(flows(800, 0.4, 0.3)).bitrate_kbps > 300


@pytest.mark.parametrize("value", [math.nan, -0.1, math.inf])
@pytest.mark.parametrize("name", ["lost", "round_trip_s", "received_kbps", "queue_s", "dropped"])
def test_a_number_that_cannot_be_changes_nothing(name: str, value: float) -> None:
    bad = {"received_kbps": 500.0, "queue_s": 0.5, "dropped": 0.5, "lost": 0.5, name: value}
    adaptation = after(told(**bad))
    assert (adaptation.bitrate_kbps, adaptation.gop_frames) == (2000, 15)


def test_no_report_however_wild_leaves_the_bounds() -> None:
    wild = [flows(1e300, 1e300, 1.0), flows(1e-300, 1e300), flows(1e300, 0.0), flows(1e-300, 0.0)]
    adaptation = Adaptation(LIMITS)
    for number in range(200):
        adaptation.report(wild[number % 4], number * 0.3)
        assert 300 <= adaptation.bitrate_kbps <= 2000
    adaptation.report(flows(1000.0), -1e9)  # a clock that is set back
    assert 300 <= adaptation.bitrate_kbps <= 2000
