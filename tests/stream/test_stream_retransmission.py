"""A lost packet that can be had again costs nothing; one that cannot is given up at once."""

from __future__ import annotations

import importlib.util
import itertools
import json
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from impaired_link import CLEAN, ImpairedLink, Impairment
from mended_link import MS, RATE_HZ, fly, sent_again, shown
from numbered_flight import (
    GOP,
    capture_ns,
    encoded,
    number_in,
    packets,
    stamped,
    start_payload,
)

from ground_station.stream import rtp
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.feedback import Feedback
from ground_station.stream.multi_stream import MultiStreamReceiver, Stream
from ground_station.stream.retransmission import LIVE_NS, Retransmission, RoundTrip
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware import gstreamer
from pi_firmware import retransmission as payloads
from pi_firmware.link import Link
from pi_firmware.retransmission import Budget, rtx_ssrc
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import rtcp
from pi_firmware.wire.srtcp import SrtcpProtector, SrtcpUnprotector

KEY = bytes(range(30))
LIMIT_S = 30.0


@settings(deadline=None, max_examples=200)
@given(st.sets(st.integers(0, 0xFFFF), max_size=80), st.integers(0, 0xFFFF))
def test_what_a_nack_asks_for_is_read_as_it_was_written(drawn: set[int], first: int) -> None:
    asked = sorted(drawn, key=lambda number: (number - first) & 0xFFFF)
    datagram = rtcp.nack(5, 77, asked)
    assert rtcp.sender_of(datagram) == 5
    assert rtcp.asked_for(datagram, 77) == asked and rtcp.asked_for(datagram, 78) == []
    receiver_report = struct.pack(">BBHI", 0x80, 201, 1, 5)
    assert rtcp.asked_for(receiver_report + datagram, 77) == asked  # compound


def test_a_nack_has_the_standards_form() -> None:
    # RFC 4585, 6.1 and 6.2.1: 65535 and two of the 16 that follow it, across the wrap.
    assert rtcp.nack(0x01020304, 0x05060708, [65535, 0, 15, 16]) == bytes.fromhex(
        "81 cd 0004 01020304 05060708 ffff 8001 0010 0000"
    )


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\x81\xcd\x00\x03",
        b"\x81\xcd\x00\x09" + bytes(12),  # longer than it is
        b"\x41\xcd\x00\x03" + bytes(12),  # another version
        b"\x81\xcd\x00\x00" + bytes(12),
        b"\x81\xce\x00\x03" + bytes(12),  # a picture loss indication's type
        b"\x82\xcd\x00\x03" + bytes(12),  # another format
    ],
)
def test_what_is_no_nack_asks_for_nothing(datagram: bytes) -> None:
    assert rtcp.asked_for(datagram, 0) == []


def test_a_large_nack_asks_for_so_much_and_no_more() -> None:
    everything = rtcp.nack(1, 77, range(0x10000))
    assert len(rtcp.asked_for(everything, 77)) == rtcp.MOST_ASKED


def test_srtcp_is_opened_once_and_by_its_key_only() -> None:
    protector, stranger = SrtcpProtector("a", KEY), SrtcpProtector("b", KEY[::-1])
    unprotector = SrtcpUnprotector(KEY)
    asked = [rtcp.nack(5, 77, [number]) for number in range(200)]
    made = [protector.protect(plain) for plain in asked]
    assert made[0][:8] == asked[0][:8] and asked[0][8:] not in made[0]
    assert unprotector.unprotect(stranger.protect(asked[0])) is None
    assert [unprotector.unprotect(packet) for packet in made[100:]] == asked[100:]
    assert [unprotector.unprotect(packet) for packet in made] == [None] * 200
    for at in range(len(made[0])):
        changed = bytearray(protector.protect(asked[0]))
        changed[at] ^= 1
        assert unprotector.unprotect(bytes(changed)) is None
    for size in range(len(made[0])):
        assert unprotector.unprotect(protector.protect(asked[0])[:size]) is None
    late, later = protector.protect(asked[1]), protector.protect(asked[2])
    assert unprotector.unprotect(later) == asked[2]
    assert unprotector.unprotect(late) == asked[1]  # overtaken is not repeated


def test_srtcp_is_what_another_implementation_takes() -> None:
    gst = gstreamer.load()
    gstreamer.require(("srtpdec",), "this test")
    # From a socket: GStreamer 1.22 hands on undecrypted what is held elsewhere, too.
    pipeline = gstreamer.launch(
        "udpsrc name=in address=127.0.0.1 port=0 ! dec.rtcp_sink "
        "srtpdec name=dec dec.rtcp_src ! appsink name=out sync=false async=false"
    )
    keyed = f"srtp-key=(buffer){KEY.hex()},srtp-cipher=aes-128-icm,srtp-auth=hmac-sha1-80"
    caps = f"application/x-srtcp,ssrc=(uint)5,{keyed},srtcp-cipher=aes-128-icm"
    source, sink = pipeline.get_by_name("in"), pipeline.get_by_name("out")
    source.set_property("caps", gst.Caps.from_string(f"{caps},srtcp-auth=hmac-sha1-80"))
    pipeline.set_state(gst.State.PLAYING)
    protector = SrtcpProtector("a", KEY)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number in range(20):
            asked = rtcp.nack(5, 77, [number, number + 9, number + 600])
            sender.sendto(protector.protect(asked), ("127.0.0.1", source.get_property("port")))
            buffer = sink.emit("try-pull-sample", 10 * 10**9).get_buffer()
            assert buffer.extract_dup(0, buffer.get_size()) == asked
    pipeline.set_state(gst.State.NULL)


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
    told = came + counters.packets_mended + counters.packets_lost
    assert sent - 60 <= told <= sent
    assert counters.packets_mended <= counters.packets_asked
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
    assert made.counters.packets_lost == 0 and made.counters.packets_mended == made.nacks == 1


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
    assert (counters.retransmissions, counters.packets_mended, counters.packets_late) == (7, 0, 0)


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
    assert counters.packets_asked == 1 and counters.packets_mended == counters.packets_late == 0


def test_what_is_sent_again_is_a_share_of_what_is_sent() -> None:
    budget = Budget(10_000)
    assert sum(budget.take(1400) for _ in range(100)) == 7
    assert not budget.take(1400)
    budget.sent(2000)
    assert budget.take(1000) and not budget.take(400)


class Flown:
    """A receiver, what it showed, and the payload's own link to it through an impaired one."""

    def __init__(self, receiver: MultiStreamReceiver, air: ImpairedLink, link: Link) -> None:
        self.receiver, self.air, self.link = receiver, air, link
        self.frames: list[ReceivedFrame] = []

    @property
    def stream(self) -> Stream:
        stream = self.receiver.stream_of("one")
        assert stream is not None
        return stream


@contextmanager
def flying(
    does: Impairment = CLEAN, key: bytes | None = None, history_s: float = 0.5
) -> Iterator[Flown]:
    frames: list[ReceivedFrame] = []
    with (
        MultiStreamReceiver(
            0,
            owner=lambda *_: "one",
            on_frame=lambda _, frame: frames.append(frame),
            srtp_keys=None if key is None else {"one": key},
        ) as receiver,
        ImpairedLink(receiver.port, does, seed=3) as air,
    ):
        link = Link(LinkSettings(port=air.port, mtu_bytes=600, history_s=history_s), 77, key)
        link.start()
        try:
            flown = Flown(receiver, air, link)
            flown.frames = frames
            yield flown
        finally:
            link.stop()


def send(flown: Flown, count: int, first: int = 0) -> None:
    for index, unit in enumerate(encoded(first + count)[first:], start=first):
        assert flown.link.send(stamped(unit, index), capture_ns(index), idr=index % GOP == 0)
        time.sleep(1 / 60)


def until(condition: Callable[[], object]) -> bool:
    deadline = time.monotonic() + LIMIT_S
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    return bool(condition())


def numbers(frames: Sequence[ReceivedFrame]) -> list[int]:
    sequences = [frame.sequence for frame in frames]
    assert [number_in(frame.image) for frame in frames] == sequences
    return sequences


@pytest.mark.parametrize("key", [None, KEY], ids=["plain", "encrypted"])
def test_the_payloads_own_link_sends_again_what_was_lost(key: bytes | None) -> None:
    with flying(key=key) as flown:
        send(flown, 5)
        assert until(lambda: len(flown.frames) == 5)
        flown.stream.retransmits(flown.link.rtx_ssrc, 0.001)
        flown.air.impair(Impairment(loss=0.05, delay_s=0.005))
        send(flown, 70, first=5)
        assert until(lambda: flown.air.idle)
        flown.air.impair(CLEAN)
        send(flown, 20, first=75)  # in which there is an IDR
        assert until(lambda: flown.frames[-1].sequence == 94)
        counters = flown.stream.counters
        # A machine that is busy with other things answers some of it too late.
        assert counters.packets_mended >= 0.7 * flown.air.counts.lost > 10
        assert counters.packets_mended + counters.packets_lost >= counters.packets_asked
        assert len(numbers(flown.frames)) == 95 - counters.withheld >= 70
        assert counters.withheld == 0 or counters.packets_lost > 0
        assert flown.receiver.counters.refused == flown.receiver.counters.other_streams == 0


def test_an_older_payload_is_asked_for_nothing() -> None:
    with flying(history_s=0.0) as flown:
        assert flown.link.rtx_ssrc is None
        send(flown, 5)
        assert until(lambda: len(flown.frames) == 5)
        flown.stream.retransmits(flown.link.rtx_ssrc, 0.001)
        flown.air.impair(Impairment(loss=0.1))
        send(flown, 30, first=5)
        assert until(lambda: flown.stream.counters.packets_lost > 0)
        assert flown.air.returned == 0 and flown.stream.counters.retransmissions == 0


def test_a_nack_without_the_key_costs_nothing_and_with_it_no_more_than_the_budget() -> None:
    with flying(key=KEY) as flown:
        send(flown, 20)
        assert until(lambda: len(flown.frames) == 20)
        came = flown.air.counts.received
        retransmission = flown.link._retransmission
        assert retransmission is not None
        newest = max(packet.sequence for packet in _heard(flown))
        asked = rtcp.nack(9, 77, [(newest - back) & 0xFFFF for back in range(60)])
        forged = SrtcpProtector("one", KEY[::-1]).protect(asked)
        address = ("127.0.0.1", flown.link._retransmission._sockets[0].getsockname()[1])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for datagram in (asked, forged, random.Random(1).randbytes(400), b"\x81\xcd"):
                stranger.sendto(datagram, address)
            time.sleep(0.3)
            assert flown.air.counts.received == came
            protector = SrtcpProtector("one", KEY)
            for _ in range(40):
                stranger.sendto(protector.protect(asked), address)
            assert until(lambda: flown.air.counts.received > came)
            time.sleep(0.5)
        assert flown.air.counts.received - came <= 2 * (64 << 10) // 600


def test_a_flood_at_the_payloads_port_is_read_slowly_and_what_is_asked_for_after_it_is_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken: list[int] = []
    take = payloads.Retransmission.take

    def counted(self: payloads.Retransmission, datagram: bytes) -> int:
        taken.append(take(self, datagram))
        return taken[-1]

    monkeypatch.setattr(payloads.Retransmission, "take", counted)
    with flying() as flown:
        send(flown, 5)
        assert until(lambda: len(flown.frames) == 5)
        retransmission = flown.link._retransmission
        assert retransmission is not None
        address = ("127.0.0.1", retransmission._sockets[0].getsockname()[1])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            began_s = time.monotonic()
            for _ in range(5000):
                stranger.sendto(b"\x81\xcd" + bytes(30), address)
            time.sleep(0.3)
            assert 20 <= len(taken) <= 40 + 200 * (time.monotonic() - began_s)
            newest = _heard(flown)[0].sequence

            def asked_and_sent() -> bool:
                stranger.sendto(rtcp.nack(1, 77, [newest]), address)
                time.sleep(0.02)
                return 1 in taken

            assert until(asked_and_sent)


def _heard(flown: Flown) -> list[rtp.Packet]:
    """The newest packet, by the receiver's own account of numbers."""
    (reorderer,) = [flown.stream._assembly._reorderer]
    newest = (reorderer._next - 1) & 0xFFFF
    return [rtp.Packet(newest, 0, 77, False, b"x", 0)]


def test_the_ssrc_of_what_is_sent_again_is_another_and_never_zero() -> None:
    for ssrc in (1, 77, 0x80000000, 0xFFFFFFFF):
        assert 0 < rtx_ssrc(ssrc) <= 0xFFFFFFFF and rtx_ssrc(ssrc) != ssrc


def test_all_packets_fit_the_mtu() -> None:
    sizes: list[int] = []
    with flying(key=KEY) as flown:
        flown.air._tap = lambda datagram, lost: sizes.append(len(datagram))
        send(flown, 5)
        assert until(lambda: len(flown.frames) == 5)
        flown.stream.retransmits(flown.link.rtx_ssrc, 0.001)
        flown.air.impair(Impairment(loss=0.2))
        send(flown, 40, first=5)
        assert until(lambda: flown.stream.counters.packets_mended > 10)
    assert max(sizes) == 600


def test_what_was_packed_by_another_is_asked_for_in_its_own_numbers() -> None:
    """Packets as `packets` numbers them, across the wrap, with one missing and sent again."""
    units = [stamped(unit, index) for index, unit in enumerate(encoded(6))]
    frames: list[ReceivedFrame] = []
    with (
        MultiStreamReceiver(
            0, owner=lambda *_: "one", on_frame=lambda _, frame: frames.append(frame)
        ) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.settimeout(5)
        datagrams = packets(units, ssrc=77, first=65_533)
        to = ("127.0.0.1", receiver.port)
        sender.sendto(datagrams[0], to)
        sender.sendto(datagrams[1], to)
        assert until(lambda: receiver.stream_of("one"))
        stream = receiver.stream_of("one")
        assert stream is not None
        stream.retransmits(99, 0.001)
        for datagram in (datagrams[2], *datagrams[4:]):
            sender.sendto(datagram, to)
        assert rtcp.asked_for(sender.recv(1500), 77) == [0]
        sender.sendto(sent_again(datagrams[3], ssrc=98), to)  # another's
        sender.sendto(sent_again(datagrams[3]), to)
        assert until(lambda: len(frames) == 6)
        assert receiver.counters.other_streams == 1


def test_a_flight_over_a_lossy_link_shows_nearly_all_of_its_frames() -> None:
    """The program that flies, its telemetry, and what it announces in it."""
    seconds = 8
    shown_at: list[int] = []
    with (
        TelemetryListener(["tcp/127.0.0.1:0"]) as listener,
        MultiStreamReceiver(
            0,
            owner=lambda *_: "blimp-1",
            on_frame=lambda _, frame: shown_at.append(frame.sequence),
        ) as receiver,
        ImpairedLink(receiver.port, Impairment(loss=0.05, delay_s=0.005), seed=3) as air,
        Feedback(listener, receiver.stream_of),
    ):
        process = start_payload(
            "payload_id=blimp-1",
            f"camera.uri=test:?pattern=zone-plate&duration_s={seconds}",
            "gate.enabled=false",
            f"link.port={air.port}",
            f"telemetry.connect={json.dumps(listener.endpoints)}",
        )
        try:
            _, err = process.communicate(timeout=LIMIT_S + seconds)
        finally:
            process.kill()
        assert process.returncode == 0, err
        assert until(lambda: air.idle)
        stream = receiver.stream_of("blimp-1")
        assert stream is not None
        assert until(lambda: _datagrams(stream) == air.counts.passed)
        state = listener.state("blimp-1")
        counters, link = stream.counters, air.counts
    assert state is not None and state.health is not None
    assert state.health.rtx_ssrc == stream.rtx_ssrc is not None
    # The first two seconds it is not known yet that anything comes again.
    late = [sequence for sequence in shown_at if sequence >= 60]
    assert len(late) >= 0.95 * (30 * seconds - 60)
    assert counters.packets_mended > 0.5 * link.lost
    assert counters.packets_lost <= 0.5 * link.lost


def _datagrams(stream: Stream) -> int:
    return stream.counters.packets + stream.counters.retransmissions


def test_however_much_is_missing_one_datagram_asks_for_it() -> None:
    missing = Retransmission(Counters())
    missing.offered = True
    for number in range(0, 2000, 20):
        missing.missed(number, 3, 0, 0)
    asked = missing.due(0)
    assert len(asked) == 256
    assert len(SrtcpProtector("a", KEY).protect(rtcp.nack(1, 77, asked))) <= 1200


@pytest.mark.parametrize("lacks", ["rtprtxsend", "cryptography"])
def test_a_card_that_lacks_something_flies_without_and_says_so(
    lacks: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An update may come to a card that was made before."""
    if lacks == "cryptography":
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    else:
        find = gstreamer.load().ElementFactory.find
        monkeypatch.setattr(
            gstreamer.load().ElementFactory,
            "find",
            lambda name: (name != lacks and find(name)) or None,
        )
    link = Link(LinkSettings(), 77, KEY)
    assert link.rtx_ssrc is None
    link.start()
    link.stop()
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"'{lacks}'" in told
