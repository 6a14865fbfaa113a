"""What the ground measures of a stream's packets: rate, queue and what overflowed."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import replace

import pytest

from ground_station.stream.arrivals import Arrivals, Flow
from ground_station.stream.rtp import Packet

MS = 1_000_000
S = 1_000_000_000
FRAME_MS = 33
PER_FRAME = 5
BYTES = 1000
START_NS = 7 * S
"""Of the receiver's clock: any."""


def packets(
    frames: Iterable[int],
    delay_ms: float = 10.0,
    *,
    sequence: int = 65_500,
    ticks: int = 2**32 - 900,
) -> list[Packet]:
    """Frames of five packets, 0.1 ms apart; sequence numbers and timestamps soon wrap."""
    made = []
    for frame in frames:
        for k in range(PER_FRAME):
            at_ns = START_NS + frame * FRAME_MS * MS + round(delay_ms * MS) + k * MS // 10
            made.append(
                Packet(
                    (sequence + frame * PER_FRAME + k) & 0xFFFF,
                    (ticks + frame * FRAME_MS * 90) & 0xFFFFFFFF,
                    1,
                    k == PER_FRAME - 1,
                    bytes(BYTES),
                    at_ns,
                )
            )
    return made


def taken(*groups: list[Packet]) -> Arrivals:
    arrivals = Arrivals()
    for group in groups:
        for packet in group:
            arrivals.add(packet)
    return arrivals


def test_the_largest_packet_is_told_once_there_are_enough() -> None:
    came = packets(range(60))
    came[-70] = replace(came[-70], payload=bytes(1300))
    assert flow(taken(came), 60).largest_bytes == 1312
    came[-200] = replace(came[-200], payload=bytes(1350))  # more than a second ago
    assert flow(taken(came), 60).largest_bytes == 1312
    few = came[:100] + came[-9:]
    assert flow(taken(few), 60).largest_bytes is None


def at(frame: int) -> int:
    return START_NS + frame * FRAME_MS * MS


def flow(arrivals: Arrivals, frame: int) -> Flow:
    seen = arrivals.flow(at(frame))
    assert seen is not None
    return seen


def test_nothing_is_told_before_there_is_something_to_tell() -> None:
    assert Arrivals().flow(at(0)) is None
    assert taken(packets(range(3))).flow(at(3)) is None


def test_a_stream_without_a_queue() -> None:
    seen = flow(taken(packets(range(60))), 60)
    assert seen.received_kbps == pytest.approx(PER_FRAME * BYTES * 8 / FRAME_MS, rel=0.1)
    assert (seen.queue_s, seen.dropped) == (0.0, 0.0)


def test_a_queue_is_what_most_frames_take_longer_than_the_fastest() -> None:
    later = packets(range(60, 80), 130.0)
    seen = flow(taken(packets(range(60)), later), 84)
    assert seen.queue_s == pytest.approx(0.12, abs=0.001)
    # One frame in three, as after each IDR, is none.
    mixed = [packets([k], 130.0 if k % 3 == 0 else 10.0 + k % 2) for k in range(60, 90)]
    assert flow(taken(packets(range(60)), *mixed), 91).queue_s == pytest.approx(0.0, abs=0.0011)


def test_a_drifting_clock_is_no_queue_and_one_that_was_set_begins_anew() -> None:
    """100 ppm, over four minutes; then the sender's clock is an hour ahead."""
    drifting = [packets([k], 10.0 + k * FRAME_MS * 1e-4) for k in range(7_200)]
    arrivals = taken(*drifting)
    assert flow(arrivals, 7_200).queue_s == pytest.approx(0.0, abs=0.004)
    for packet in packets(range(7_200, 7_230), 40.0, ticks=3600 * 90_000):
        arrivals.add(packet)
    assert flow(arrivals, 7_231).queue_s == pytest.approx(0.0, abs=0.001)


def test_the_fastest_is_forgotten_after_half_a_minute() -> None:
    """A single early packet, of a clock's hiccup, is not to be believed for ever."""
    arrivals = taken(packets(range(30)), packets([30], -90.0), packets(range(31, 600)))
    assert flow(arrivals, 600).queue_s == pytest.approx(0.1, abs=0.001)
    for packet in packets(range(600, 1_000)):
        arrivals.add(packet)
    assert flow(arrivals, 1_000).queue_s == pytest.approx(0.0, abs=0.001)


def test_a_delay_that_stays_although_less_is_sent_is_the_ways_own() -> None:
    arrivals = taken(packets(range(60)), packets(range(60, 120), 110.0))
    assert flow(arrivals, 121).queue_s == pytest.approx(0.1, abs=0.001)
    for packet in packets(range(120, 300), 110.0):  # and on: as much as before is still a queue
        arrivals.add(packet)
    assert flow(arrivals, 301).queue_s == pytest.approx(0.1, abs=0.001)
    fewer = [p for n, p in enumerate(packets(range(300, 360), 110.0)) if n % 5 < 2]
    for number, packet in enumerate(fewer):
        sequence = (65_500 + 300 * PER_FRAME + number) & 0xFFFF
        arrivals.add(
            Packet(sequence, packet.timestamp, 1, False, packet.payload, packet.arrival_ns)
        )
    assert flow(arrivals, 361).queue_s == pytest.approx(0.0, abs=0.001)


def test_losses_are_counted_and_disorder_and_duplicates_are_none() -> None:
    draw = random.Random(5)
    sent = packets(range(60))
    lossy = [packet for packet in sent if draw.random() >= 0.2]
    assert flow(taken(lossy), 60).dropped == pytest.approx(0.2, abs=0.07)
    swapped = [p for pair in zip(sent[1::2], sent[::2], strict=True) for p in pair]
    seen = flow(taken([p for packet in swapped for p in (packet, packet)]), 60)
    assert seen.dropped == 0.0
    assert seen.received_kbps == flow(taken(sent), 60).received_kbps


def test_corrections_load_the_link_and_how_many_are_lost_in_a_row_is_told() -> None:
    sent = packets(range(60))
    beside = [replace(p, payload=bytes(BYTES), corrects=True) for p in sent[::PER_FRAME]]
    plain, more = flow(taken(sent), 60), flow(taken(sent, beside), 60)
    assert plain.burst is None and more.retransmitted_kbps == more.dropped == 0.0
    assert more.received_kbps == pytest.approx(1.2 * plain.received_kbps, rel=0.03)
    # Every tenth, and beside it the two after every thirtieth.
    lost = {k for k in range(0, 290) if k % 10 == 5 or k % 30 in (6, 7)}
    kept = [p for k, p in enumerate(sent) if k not in lost]
    assert flow(taken(kept), 60).burst == pytest.approx(5 / 3, rel=0.1)


def test_what_an_outage_takes_is_not_dropped() -> None:
    arrivals = taken(packets(range(60)), packets(range(90, 100)))
    assert flow(arrivals, 101).dropped == 0.0
    silent = flow(arrivals, 140)
    assert (silent.received_kbps, silent.queue_s, silent.dropped) == (0.0, None, 0.0)


def test_sequence_numbers_from_elsewhere_begin_anew_and_hold_no_memory() -> None:
    draw = random.Random(6)
    arrivals = taken(packets(range(60)))
    for n in range(2_000):
        wild = Packet(draw.randrange(1 << 16), draw.randrange(1 << 32), 1, True, b"x", at(60) + n)
        arrivals.add(wild)
    assert len(arrivals._missing) <= 512
    arrivals = taken(packets(range(60)), packets(range(60, 120), sequence=30_000))
    assert flow(arrivals, 120).dropped == 0.0
