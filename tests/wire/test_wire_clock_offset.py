"""A payload's clock may be anything: its offset is found within the bound that is told."""

import random

import pytest

from pi_firmware.wire.clock_offset import OffsetFilter, RoundTrip, ask
from pi_firmware.wire.telemetry import open_session

HOUR_NS = 3_600_000_000_000
NOW_NS = 1_900_000_000 * 10**9


def trip(at_ns: int, offset_ns: int, there_ns: int, back_ns: int) -> RoundTrip:
    received_ns = at_ns + there_ns + offset_ns
    return RoundTrip(at_ns, received_ns, received_ns + 1000, at_ns + there_ns + 1000 + back_ns)


@pytest.mark.parametrize("offset_ns", [0, -NOW_NS, HOUR_NS])
def test_the_offset_is_within_its_uncertainty(offset_ns: int) -> None:
    draw = random.Random(4)
    filtered = OffsetFilter()
    for second in range(100):
        there, back = (int(1e5 + draw.expovariate(1 / 5e6)) for _ in range(2))
        found = filtered.add(trip(NOW_NS + second * 10**9, offset_ns, there, back))
        assert found is not None
        assert abs(found.offset_ns - offset_ns) <= found.uncertainty_ns
    assert found.uncertainty_ns < 4_000_000 and found.steps == 0
    assert abs(found.to_ours(NOW_NS + offset_ns) - NOW_NS) <= found.uncertainty_ns


def test_a_drifting_clock_is_followed() -> None:
    filtered = OffsetFilter()
    for second in range(600):
        offset_ns = second * 40_000  # 40 ppm
        found = filtered.add(trip(NOW_NS + second * 10**9, offset_ns, 200_000, 200_000))
        assert found is not None and abs(found.offset_ns - offset_ns) <= found.uncertainty_ns
    assert found.steps == 0


@pytest.mark.parametrize("step_ns", [-HOUR_NS, HOUR_NS, 20_000_000])
def test_a_step_of_their_clock_counts_and_holds_at_once(step_ns: int) -> None:
    filtered = OffsetFilter()
    for second in range(10):
        filtered.add(trip(NOW_NS + second * 10**9, 0, 200_000, 200_000))
    found = filtered.add(trip(NOW_NS + 10**10, step_ns, 200_000, 200_000))
    assert found is not None and found.offset_ns == step_ns and found.steps == 1


def test_our_own_step_back_is_handled() -> None:
    filtered = OffsetFilter()
    filtered.add(trip(NOW_NS, 0, 200_000, 200_000))
    found = filtered.add(trip(NOW_NS - HOUR_NS, HOUR_NS, 200_000, 200_000))
    assert found is not None and found.offset_ns == HOUR_NS and found.steps == 1


def test_a_step_inside_a_round_trip_is_not_believed() -> None:
    filtered = OffsetFilter()
    assert filtered.add(RoundTrip(NOW_NS, NOW_NS, NOW_NS, NOW_NS - HOUR_NS)) is None
    assert filtered.add(RoundTrip(NOW_NS, NOW_NS, NOW_NS - HOUR_NS, NOW_NS + 1)) is None


def test_answers_that_are_no_times_are_refused() -> None:
    here = open_session(listen=["tcp/127.0.0.1:0"])
    for body in (b"", b"[]", b'{"received_ns":1}', b'{"received_ns":1e9,"replied_ns":true}'):
        served = here.zenoh.declare_queryable(
            "blimp/x/clock", lambda q, b=body: q.reply(q.key_expr, b)
        )
        assert ask(here.zenoh, "blimp/x/clock") is None
        served.undeclare()
    here.close()
