"""A lost packet that can be had again costs nothing; one that cannot is given up at once."""

from __future__ import annotations

import itertools
import struct

import pytest
from impaired_link import CLEAN, Impairment
from numbered_flight import (
    GOP,
)
from recovering_link import MS, RATE_HZ, fly, sent_again, shown

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from ground_station.stream.retransmission import LIVE_NS, Retransmission, RoundTrip
from pi_firmware.wire import rtcp
from pi_firmware.wire.srtcp import SrtcpProtector

KEY = bytes(range(30))


def test_what_is_missing_is_asked_for_at_once_and_again_after_a_round_trip() -> None:
    counters = Counters()
    missing = Retransmission(counters)
    missing.offered = True
    missing.round_trip.hint(20 * MS, 0)
    missing.missed(65534, 3, 0, 0)
    asked = [(now, missing.due(now * MS)) for now in range(200)]
    times = [now for now, sequences in asked if sequences]
    assert asked[0][1] == [65534, 65535, 0] and counters.packets_asked == 3
    assert all(after - before >= 20 for before, after in itertools.pairwise(times))
    # No more once it could not be here in time, and then it is given up.
    assert 80 < times[-1] <= LIVE_NS / MS - 20
    assert not missing.awaits(65534) and missing.next_ns() is None


def test_what_comes_tells_the_round_trip_and_what_comes_twice_that_it_is_longer_now() -> None:
    missing = Retransmission(Counters())
    missing.offered = True
    missing.round_trip.hint(12 * MS, 0)
    for number in range(50):
        begin_ns = number * 1000 * MS
        missing.missed(number, 1, 0, begin_ns)
        missing.due(begin_ns)
        assert missing.came(number, begin_ns + 12 * MS, again=True)
    assert missing.round_trip.smoothed_ns == pytest.approx(12 * MS, rel=0.01)
    assert missing.round_trip.timeout_ns < 25 * MS
    # The way is longer now: each is asked for again before the first answer is here.
    asked = 0
    for number in range(50, 90):
        begin_ns, asked = number * 1000 * MS, 0
        missing.missed(number, 1, 0, begin_ns)
        for now in range(60):
            asked += bool(missing.due(begin_ns + now * MS))
        assert missing.came(number, begin_ns + 60 * MS, again=True)
        for answer in range(1, asked):
            assert not missing.came(number, begin_ns + (60 + 20 * answer) * MS, again=True)
    assert asked == 1 and missing.round_trip.timeout_ns > 60 * MS
    assert not missing.came(7, 0, again=True)  # nobody waits for it


def test_where_packets_overtake_each_other_they_are_asked_for_later() -> None:
    counters = Counters()
    missing = Retransmission(counters)
    missing.offered = True
    missing.round_trip.hint(10 * MS, 0)
    for number in range(40):
        begin_ns = number * 1000 * MS
        missing.missed(number, 1, 0, begin_ns)
        for now in range(8):
            missing.due(begin_ns + now * MS)
        assert missing.came(number, begin_ns + 8 * MS, again=False)
    assert counters.packets_asked == 1  # the first, before it was known
    for number in range(40, 80):  # no longer
        begin_ns = number * 1000 * MS
        missing.missed(number, 1, 0, begin_ns)
        asked = next(now for now in range(30) if missing.due(begin_ns + now * MS))
        assert missing.came(number, begin_ns + (asked + 10) * MS, again=True)
    assert asked <= 1
    # However late some were, a frame is not waited for without a question.
    missing.missed(80, 1, 0, 10**12)
    assert missing.came(80, 10**12 + 140 * MS, again=False)
    missing.missed(81, 1, 0, 2 * 10**12)
    assert missing.next_ns() == 2 * 10**12 + 30 * MS


def test_a_round_trip_from_telemetry_counts_until_there_is_one_of_its_own() -> None:
    trip = RoundTrip()
    assert trip.timeout_ns == LIVE_NS
    trip.hint(200 * MS, 0)
    assert trip.smoothed_ns == 200 * MS
    trip.measure(10 * MS, 0)
    trip.hint(200 * MS, 1)
    assert trip.smoothed_ns == 10 * MS
    trip.hint(200 * MS, 6_000 * MS)
    assert trip.smoothed_ns == 200 * MS


def small_frames(count: int, packets_each: int = 6) -> list[list[bytes]]:
    """Frames whose last four bytes are their number, each 15th an IDR, of FU-A packets."""
    made, sequence = [], 65_000
    for index in range(count):
        nal = bytes([0x65 if index % GOP == 0 else 0x61]) + bytes(40) + index.to_bytes(4, "big")
        step = -(-(len(nal) - 1) // packets_each)
        pieces = [nal[at : at + step] for at in range(1, len(nal), step)]
        datagrams = []
        for place, piece in enumerate(pieces):
            last = place == len(pieces) - 1
            ends = (0x80 if place == 0 else 0) | (0x40 if last else 0)
            head = struct.pack(
                ">BBHII", 0x80, (0x80 if last else 0) | 96, sequence & 0xFFFF, 3000 * index, 77
            )
            datagrams.append(head + bytes([nal[0] & 0xE0 | 28, ends | nal[0] & 0x1F]) + piece)
            sequence += 1
        made.append(datagrams)
    return made


BURSTS = Impairment(burst_start=0.03 / 10 / 0.97, burst_end=0.1)


@pytest.mark.parametrize(
    ("does", "round_trip_ms", "least", "p99_ms"),
    [
        (Impairment(loss=0.02), 10, 0.999, 60),
        (Impairment(loss=0.05), 10, 0.997, 70),
        (BURSTS, 10, 0.97, 150),
        (Impairment(loss=0.10), 30, 0.95, 150),
    ],
)
def test_a_lossy_link_shows_nearly_all_frames(
    does: Impairment, round_trip_ms: int, least: float, p99_ms: int
) -> None:
    frames = small_frames(900)
    idr = range(0, 900, GOP)
    without = fly(frames, does, round_trip_ms=round_trip_ms, seed=4, offered=False)
    made = fly(frames, does, round_trip_ms=round_trip_ms, seed=4)
    assert len(shown(made, idr)) >= least * 900 > len(shown(without, idr))
    # Each packet that was sent is one of three things; the last ones' loss is never noticed.
    counters, sent = made.counters, sum(map(len, frames))
    came = counters.packets - counters.packets_late
    told = came + counters.packets_recovered + counters.packets_lost
    assert sent - 60 <= told <= sent
    assert counters.packets_recovered <= counters.packets_asked
    delays_ms = sorted(
        at_ms - 1000 * int.from_bytes(unit.data[-4:], "big") // RATE_HZ
        for at_ms, unit in made.units
        if unit.complete
    )
    assert delays_ms[len(delays_ms) * 99 // 100] <= p99_ms


def test_a_clean_link_is_asked_for_nothing_and_nobody_waits() -> None:
    made = fly(small_frames(300), CLEAN)
    assert made.nacks == made.again == 0 and made.counters.packets_lost == 0
    assert len(shown(made, [0])) == 300


def test_what_never_comes_holds_nobody_up_for_longer_than_its_deadline() -> None:
    frames = small_frames(60)
    del frames[20][3]
    made = fly(frames, CLEAN, history_ms=0)
    held = [at_ms - 1000 * 21 // RATE_HZ for at_ms, unit in made.units if unit.data[-1:] == b"\x15"]
    assert made.counters.packets_lost == 1 and made.nacks > 1
    assert LIVE_NS / MS - 40 <= held[0] <= LIVE_NS / MS + 10


def test_a_long_silence_is_not_asked_for_but_a_little_after_one_is() -> None:
    frames = small_frames(60)
    cut = [*frames[:20], *([[]] * 15), *frames[35:]]
    made = fly(cut, CLEAN)
    assert made.nacks == 0 and made.counters.packets_lost == 15 * 6
    # A frame's end, missed with the next one a second later.
    rare = [frame for frame in frames[:20] for frame in (frame, *([[]] * 29))]
    made = fly(rare, CLEAN, history_ms=1500, drop={6 * 8 - 1})
    assert made.counters.packets_lost == 0 and made.counters.packets_recovered == made.nacks == 1


def test_a_retransmission_that_nobody_waits_for_changes_nothing() -> None:
    counters = Counters()
    reorderer = rtp.Reorderer(counters)
    reorderer.retransmission.offered = True
    frames = small_frames(2)
    ready = []
    for datagram in frames[0]:
        for copy in (datagram, sent_again(datagram)):
            packet = rtp.parse(copy, 0)
            assert packet is not None
            ready += reorderer.push(packet)
    far = rtp.parse(sent_again(frames[1][3]), 0)
    assert far is not None and [*reorderer.push(far)] == []
    assert len(ready) == 6 and not any(gap for _, gap in ready)
    assert (counters.retransmissions, counters.packets_recovered, counters.packets_late) == (
        7,
        0,
        0,
    )


def test_a_reordered_packet_is_received_and_what_came_again_is_not_counted_twice() -> None:
    counters = Counters()
    reorderer = rtp.Reorderer(counters)
    reorderer.retransmission.offered = True
    (datagrams,) = small_frames(1)
    order = [*datagrams[:2], datagrams[3], datagrams[2], sent_again(datagrams[2]), *datagrams[4:]]
    taken = []
    for datagram in order:
        packet = rtp.parse(datagram, 0)
        assert packet is not None
        taken += reorderer.push(packet)
        reorderer.retransmission.due(0)
    assert [packet.sequence for packet, _ in taken] == [*range(65_000, 65_006)]
    assert counters.packets_asked == 1 and counters.packets_recovered == counters.packets_late == 0


def test_however_much_is_missing_one_datagram_asks_for_it() -> None:
    missing = Retransmission(Counters())
    missing.offered = True
    for number in range(0, 2000, 20):
        missing.missed(number, 3, 0, 0)
    asked = missing.due(0)
    assert len(asked) == 256
    assert len(SrtcpProtector("a", KEY).protect(rtcp.nack(1, 77, asked))) <= 1200
