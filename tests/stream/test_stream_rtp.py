"""Packets become access units again, in order, and every gap is noticed."""

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numbered_flight import encoded, packets, stamped

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from ground_station.stream.rtp import AccessUnit
from pi_firmware.wire import annexb

MS = 1_000_000


def received(datagrams: list[bytes], step_ns: int = MS) -> tuple[list[AccessUnit], Counters]:
    """What a receiver makes of datagrams that arrive `step_ns` apart."""
    counters = Counters()
    reorderer, depacketizer = rtp.Reorderer(counters), rtp.Depacketizer(counters)
    units: list[AccessUnit] = []
    now_ns = 0
    for number, datagram in enumerate([*datagrams, None]):
        now_ns = number * step_ns + (10**9 if datagram is None else 0)
        packet = rtp.parse(datagram, now_ns) if datagram is not None else None
        ready = list(reorderer.push(packet)) if packet else []
        for ordered, gap in [*ready, *reorderer.expire(now_ns)]:
            units += depacketizer.push(ordered, gap)
    return units, counters


def flight_units(frames: int = 20, slices: int = 1) -> list[bytes]:
    return [stamped(unit, index) for index, unit in enumerate(encoded(frames, slices=slices))]


def nal_units(data: bytes) -> list[bytes]:
    return list(annexb.nal_units(data))


@pytest.mark.parametrize("slices", [1, 4])
@pytest.mark.parametrize("mtu_bytes", [200, 1200])
def test_access_units_come_out_as_they_went_in(slices: int, mtu_bytes: int) -> None:
    sent = flight_units(slices=slices)
    units, counters = received(packets(sent, mtu_bytes=mtu_bytes))
    assert [nal_units(unit.data) for unit in units] == [nal_units(unit) for unit in sent]
    assert all(unit.complete and not unit.missing_before for unit in units)
    assert counters == Counters()


def test_packets_out_of_order_are_put_in_order_without_loss() -> None:
    sent = flight_units()
    datagrams = packets(sent)
    rng = random.Random(5)
    shuffled = [
        datagram
        for _, datagram in sorted(
            enumerate(datagrams), key=lambda entry: entry[0] + rng.uniform(0, 6)
        )
    ]
    # The very first packet says where the stream starts.
    shuffled.remove(datagrams[0])
    units, counters = received([datagrams[0], *shuffled])
    assert [nal_units(unit.data) for unit in units] == [nal_units(unit) for unit in sent]
    assert all(unit.complete for unit in units)
    assert counters.packets_lost == 0


def test_duplicates_change_nothing_and_are_counted() -> None:
    sent = flight_units()
    datagrams = [datagram for datagram in packets(sent) for _ in range(2)]
    units, counters = received(datagrams)
    assert [nal_units(unit.data) for unit in units] == [nal_units(unit) for unit in sent]
    assert counters.packets_late == len(datagrams) // 2


@settings(deadline=None, max_examples=60)
@given(st.sets(st.integers(1, 10_000), max_size=12))
def test_a_lost_packet_never_leaves_its_access_unit_complete(drawn: set[int]) -> None:
    sent = flight_units()
    datagrams = packets(sent)
    lost = {number % len(datagrams) for number in drawn} - {0}
    kept = [datagram for number, datagram in enumerate(datagrams) if number not in lost]
    units, counters = received(kept)
    whole = [nal_units(unit) for unit in sent]
    for unit in units:
        assert not unit.complete or nal_units(unit.data) in whole
    last = max((number for number in range(len(datagrams)) if number not in lost), default=0)
    assert counters.packets_lost == sum(number < last for number in lost)
    # Between two units without a gap, nothing is missing.
    places = [whole.index(nal_units(unit.data)) if unit.complete else None for unit in units]
    for (before, after), unit in zip(pairwise(places), units[1:], strict=True):
        if before is not None and after is not None and not unit.missing_before:
            assert after == before + 1


def test_an_idr_after_a_gap_is_complete_when_the_gap_lies_before_it() -> None:
    sent = flight_units(frames=16)  # 15 is an IDR
    datagrams = packets(sent)
    count_15 = len(packets(sent[:15]))
    units, _ = received([*datagrams[: count_15 - 1], *datagrams[count_15:]])
    assert not units[14].complete
    assert units[15].complete and units[15].missing_before


def test_a_sender_that_begins_anew_is_followed_but_a_stray_packet_is_not() -> None:
    first, second = flight_units()[:15], flight_units()
    stray = packets(first, first=20_000)[0]
    begun = packets(first, first=100)
    again = packets(second, first=40_000)
    units, counters = received([*begun[:30], stray, *begun[30:], *again])
    assert len(units) == len(first) + len(second)
    assert all(unit.complete for unit in units)
    assert counters.packets_lost == 0
    assert [unit.missing_before > 0 for unit in units].index(True) == len(first)


def test_what_turns_out_lost_is_waited_for_less_until_one_was_late() -> None:
    counters = Counters()
    reorderer, ms = rtp.Reorderer(counters), 1_000_000

    def waited_ms(first: int) -> int:
        """For the packet that is missing before the second of two."""
        pair = [rtp.Packet(first + n, 0, 1, False, b"a", 1000 * first * ms) for n in (0, 2)]
        assert [p.sequence for packet in pair for p, _ in reorderer.push(packet)] == [first]
        began = 1000 * first
        while not list(reorderer.expire(began * ms)):
            began += 1
        return began - 1000 * first

    assert waited_ms(0) == 30
    waits = [waited_ms(3 * n) for n in range(1, 20)]
    assert waits == sorted(waits, reverse=True) and 5 <= waits[-1] <= 7
    list(reorderer.push(rtp.Packet(58, 0, 1, False, b"a", 57_001 * ms)))
    assert counters.packets_late == 1 and waited_ms(60) == 30


def test_aggregated_packets_are_taken_apart() -> None:
    (sent,) = flight_units(frames=1)
    small = [nal for nal in nal_units(sent) if len(nal) < 500]
    aggregate = bytes([24]) + b"".join(len(nal).to_bytes(2, "big") + nal for nal in small)
    header = packets([sent])[0][:12]
    (unit,), counters = received([header[:1] + b"\xe0" + header[2:] + aggregate])
    assert nal_units(unit.data) == small
    assert unit.complete and counters.malformed == 0


@pytest.mark.parametrize(
    "payload",
    [
        b"\x18\x00",  # STAP-A without a unit
        b"\x18\x00\x00",  # with an empty one
        b"\x18\xff\xff\x41",  # with one longer than the packet
        b"\x1c\x85",  # FU-A without data
        b"\x1c\x05\x00",  # FU-A that never began
        b"\x1d\x85\x00\x00\x00",  # FU-B, which this sender does not use
        b"\x00\x01",  # a type that RFC 6184 does not define
    ],
)
def test_a_malformed_payload_makes_its_access_unit_incomplete(payload: bytes) -> None:
    header = packets(flight_units(frames=1))[0][:12]
    (unit,), counters = received([header[:1] + b"\xe0" + header[2:] + payload])
    assert not unit.complete
    assert counters.malformed == 1


def test_what_was_lost_is_lost_and_not_malformed() -> None:
    """An IDR in fragments, of which the first, or one between, does not come."""
    datagrams = packets(flight_units(frames=1))
    begins = next(n for n, one in enumerate(datagrams) if one[12] & 0x1F == 28)
    for missing in (begins, begins + 1):
        (unit,), counters = received([*datagrams[:missing], *datagrams[missing + 1 :]])
        assert not unit.complete and counters.packets_lost == 1
        assert counters.malformed == 0


@settings(deadline=None, max_examples=300)
@given(st.lists(st.binary(max_size=60), max_size=20))
def test_any_datagrams_are_taken_or_refused(datagrams: list[bytes]) -> None:
    received(datagrams)
    received([b"\x80\x60\x00" + bytes([n]) + b"\x00" * 8 + d for n, d in enumerate(datagrams)])


def test_header_extensions_sources_and_padding_are_passed_over() -> None:
    plain = packets([b"\x00\x00\x01\x65\x11\x22"])[0]
    header, payload = plain[:12], plain[12:]
    themed = (
        bytes([0xB1]) + header[1:] + b"\x00" * 4 + b"\xbe\xde\x00\x01\x00\x00\x00\x00"
        + payload + b"\x00\x00\x03"
    )  # fmt: skip
    packet = rtp.parse(themed, 0)
    assert packet is not None and packet.payload == payload
    assert rtp.parse(themed[:20], 0) is None
    assert rtp.parse(bytes([0xA0]) + header[1:] + b"\x41\xff", 0) is None


@pytest.mark.parametrize("change", [(0, 0x40), (1, 0x61)])
def test_another_version_or_payload_type_is_no_packet(change: tuple[int, int]) -> None:
    datagram = bytearray(packets([b"\x00\x00\x01\x65\x11"])[0])
    assert rtp.parse(bytes(datagram), 0) is not None
    datagram[change[0]] = change[1]
    assert rtp.parse(bytes(datagram), 0) is None
