"""What is lost on a link without a quick return is found from corrections of the same frame."""

from __future__ import annotations

import itertools
import math
import random
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest
from impaired_link import CLEAN, Impairment
from numbered_flight import GOP
from recovering_link import MS, RATE_HZ, Recovered, fly, shown
from test_stream_retransmission import BURSTS, small_frames

from ground_station.stream import rtp
from ground_station.stream.correction import Correction
from ground_station.stream.counters import Counters
from pi_firmware import gstreamer
from pi_firmware.correction import Forecast, Sender, layout, protect, size
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import ulpfec
from pi_firmware.wire.messages import LinkReport

IDR = range(0, 900, GOP)
TWO_PERCENT, PAIRS = Impairment(loss=0.02), Impairment(burst_start=0.015 / 0.97, burst_end=0.5)


def told(made: Recovered) -> int:
    """The packets that were sent, by what became of them: each is one of four things."""
    counters = made.counters
    came = counters.packets - counters.packets_late
    return came + counters.packets_recovered + counters.packets_corrected + counters.packets_lost


@pytest.mark.parametrize(
    ("does", "least"),
    [(TWO_PERCENT, 0.97), (Impairment(loss=0.05), 0.96), (PAIRS, 0.94)],
)
def test_on_a_one_way_link_corrections_alone_show_nearly_all_frames(
    does: Impairment, least: float
) -> None:
    frames = small_frames(900)
    without = fly(frames, does, seed=4, offered=False)
    made = fly(frames, does, seed=4, offered=False, corrected=True)
    assert len(shown(made, IDR)) >= least * 900 > 1.3 * len(shown(without, IDR))
    assert made.counters.packets_corrected > 5 * made.counters.packets_lost
    sent = 6 * len(frames)
    assert sent - 60 <= told(made) <= sent  # the last ones' loss is never noticed
    late_ms = sorted(
        at_ms - 1000 * int.from_bytes(unit.data[-4:], "big") // RATE_HZ
        for at_ms, unit in made.units
        if unit.complete
    )
    assert late_ms[len(late_ms) * 99 // 100] <= 50  # a frame without corrections waits for 30


def test_a_clean_link_carries_no_bit_more_and_neither_does_a_quick_one() -> None:
    frames = small_frames(300)
    for does, offered in ((CLEAN, False), (CLEAN, True), (TWO_PERCENT, True), (BURSTS, True)):
        made = fly(frames, does, seed=4, offered=offered, corrected=True)
        assert made.correction_bytes == made.counters.packets_lost == 0


def test_an_older_ground_station_is_sent_none() -> None:
    made = fly(small_frames(150), TWO_PERCENT, seed=4, offered=False)
    assert made.correction_bytes == 0 < made.counters.packets_lost


def test_a_long_round_trip_is_told_by_what_comes_too_late() -> None:
    made = fly(small_frames(900), TWO_PERCENT, seed=4, round_trip_ms=200, corrected=True)
    assert len(shown(made, IDR)) >= 0.96 * 900
    assert made.counters.packets_recovered == 0


def test_both_together_mend_a_tenth() -> None:
    does = Impairment(loss=0.1)
    made = fly(small_frames(900), does, seed=4, round_trip_ms=30, corrected=True)
    counters = made.counters
    assert len(shown(made, IDR)) >= 0.97 * 900
    assert counters.packets_corrected > 0 and counters.packets_recovered > 0


def test_bursts_that_no_correction_of_a_frame_outlasts_are_given_up() -> None:
    made = fly(small_frames(300), BURSTS, seed=4, offered=False, corrected=True)
    assert made.counters.packets_lost > 50 and made.counters.corrections == 0


def frame(packets: int, seed: int = 1) -> list[bytes]:
    """A frame's RTP packets, whose sequence numbers pass zero, of random sizes."""
    draw = random.Random(seed)
    return [
        struct.pack(
            ">BBHII", 0x80, (k == packets - 1) << 7 | 96, (65_530 + k) & 0xFFFF, 9 << 28, 77
        )
        + draw.randbytes(draw.randrange(1, 90))
        for k in range(packets)
    ]


def given(frame: Sequence[bytes], corrections: int) -> list[bytes]:
    """Their corrections, as RTP."""
    head = struct.pack(">BBHII", 0x80, 98, 5, 9 << 28, 78)
    return [head + payload for payload in protect(frame, corrections)]


def found(datagrams: Sequence[bytes]) -> Iterator[rtp.Packet]:
    correction = Correction()
    correction.offered = True
    for datagram in datagrams:
        packet = rtp.parse(datagram, 0)
        assert packet is not None
        yield from correction.take(packet)


@pytest.mark.parametrize(("packets", "corrections"), [(4, 3), (11, 4), (11, 5), (48, 16)])
def test_any_two_packets_are_had_back_and_in_any_order(packets: int, corrections: int) -> None:
    sent = frame(packets)
    both = sent + given(sent, corrections)
    originals = [rtp.parse(datagram, 0) for datagram in sent]
    draw = random.Random(2)
    pairs = list(itertools.combinations(range(len(both)), 2))
    for lost in draw.sample(pairs, min(len(pairs), 60)):
        came = [datagram for k, datagram in enumerate(both) if k not in lost]
        draw.shuffle(came)
        back = {
            packet.sequence: replace(packet, ssrc=77, corrected=False) for packet in found(came)
        }
        for k in lost:
            assert k >= packets or back[(65_530 + k) & 0xFFFF] == originals[k]


def test_large_frames_are_protected_in_blocks_and_no_block_spans_two() -> None:
    sender = Sender(LinkSettings(assumed_loss=0.02), 77, sends_again=False)
    sent = frame(100)
    made = [rtp.parse(datagram, 0) for datagram in sender.of(sent)]
    assert {packet.timestamp for packet in made if packet} == {9 << 28}
    covered: set[int] = set()
    for packet in made:
        correction = packet and ulpfec.Correction.decode(packet.payload)
        assert packet is not None and correction is not None
        covered.update(correction.sequences)
    assert covered == {(65_530 + k) & 0xFFFF for k in range(100)}
    numbers = [packet.sequence for packet in made if packet]
    assert all((after - before) & 0xFFFF == 1 for before, after in itertools.pairwise(numbers))


@pytest.mark.parametrize("packets", [10, 30])
def test_gstreamers_own_encoder_makes_the_same_bytes(packets: int) -> None:
    gst, sent = gstreamer.load(), frame(packets)
    pipeline = gstreamer.launch(
        "appsrc name=packets format=time caps=application/x-rtp,payload=96,clock-rate=90000,"
        f"media=video,encoding-name=H264 ! rtpulpfecenc pt=98 percentage={100 // packets + 1}"
        " ! appsink name=out sync=false"
    )
    pipeline.set_state(gst.State.PLAYING)
    for datagram in sent:
        pipeline.get_by_name("packets").emit("push-buffer", gst.Buffer.new_wrapped(datagram))
    out = pipeline.get_by_name("out")
    buffers = [out.emit("pull-sample").get_buffer() for _ in range(packets + 1)]
    pipeline.set_state(gst.State.NULL)
    theirs = buffers[-1].extract_dup(0, buffers[-1].get_size())
    assert [theirs[12:]] == [*protect(sent, 1)]


def test_nothing_is_made_of_corrections_that_contradict_the_video() -> None:
    sent = frame(6)
    (parity,) = given(sent, 1)
    with_extension = bytes([sent[0][0] | 0x10]) + sent[0][1:12] + bytes(4) + sent[0][12:]
    forged = [
        [parity[:-1], *sent[1:]],  # cut
        [parity[:12] + b"\x80" + parity[13:], *sent[1:]],  # extended
        [parity[:13] + bytes([parity[13] ^ 1]) + parity[14:], *sent[1:]],  # of another type
        [parity[:16] + b"\1" + parity[17:], *sent[1:]],  # of another frame
        [parity[:24] + bytes(2) + parity[26:], *sent[1:]],  # of no packet
        [parity, with_extension, *sent[2:]],
    ]
    assert len([*found([parity, *sent[1:]])]) == 1
    for datagrams in forged:
        assert [*found(datagrams)] == []


def test_a_packet_that_is_found_is_waited_for_no_longer_and_counted_once() -> None:
    counters = Counters()
    reorderer = rtp.Reorderer(counters)
    reorderer.retransmission.offered = True
    correction = Correction()
    correction.offered = True
    sent = frame(4)
    taken = []
    for datagram in (*sent[:1], *sent[2:], *given(sent, 1), sent[1]):
        packet = rtp.parse(datagram, 0)
        assert packet is not None
        if not packet.corrects:
            taken += reorderer.push(packet)
        for each in correction.take(packet):
            taken += reorderer.push(each)
    assert [packet.sequence for packet, _ in taken] == [65_530, 65_531, 65_532, 65_533]
    assert reorderer.retransmission.next_ns() is None
    assert (counters.packets_corrected, counters.packets_late, counters.packets_lost) == (1, 1, 0)


def test_while_its_corrections_may_come_a_slow_frame_is_not_given_up() -> None:
    counters = Counters()
    for corrected in (False, True):
        reorderer = rtp.Reorderer(counters)
        reorderer.corrected_ns = 0 if corrected else None
        taken = []
        for k, datagram in enumerate(frame(12)):
            packet = rtp.parse(datagram, 5 * MS * k)
            assert packet is not None
            taken += [] if k == 1 else reorderer.push(packet)
            taken += reorderer.expire(5 * MS * k)
        assert len(taken) == (1 if corrected else 11)
    assert len([*reorderer.expire(200 * MS)]) == 10  # nor longer than a frame can be shown


def test_a_size_needs_no_more_than_the_losses_and_none_where_it_is_in_vain() -> None:
    assert size(6, 0.001, 1.0, 6) <= 1 < size(6, 0.02, 1.0, 6) < size(6, 0.1, 1.0, 6)
    assert size(6, 0.02, 1.0, 6) < size(6, 0.02, 2.0, 6)
    assert size(6, 0.03, 10.0, 6) == 0 < size(6, 0.03, 3.0, 6)
    assert len(layout(6, 6)) == 6 and {place for row in layout(6, 6) for place in row} == {
        *range(6)
    }


def test_a_quick_return_takes_over_from_corrections_that_were_there_before() -> None:
    """What was lost before the ground knew that it can ask says that asking does not help."""
    forecast = Forecast(LinkSettings(), sends_again=True)
    report = LinkReport(1, "main", 5600, corrects=True, dropped=0.1, burst=1.0, packets_lost=18)
    forecast.report(report, 0.0)
    assert forecast.loss == pytest.approx(0.1)
    for second in range(
        1, 6
    ):  # corrections leave nothing to be recovered, and still it is answered
        forecast.report(replace(report, answered=5 * second), float(second))
    assert forecast.loss < 0.01


def test_losses_that_end_while_a_frame_is_sent_end_its_corrections() -> None:
    sender = Sender(LinkSettings(assumed_loss=0.02), 77, sends_again=False)
    assert len([*sender.of(frame(6))]) == 3
    sender.forecast.loss = 0.0
    assert [*sender.of(frame(6))] == []


def test_a_forecast_follows_reports_and_ignores_those_that_cannot_be() -> None:
    forecast = Forecast(LinkSettings(), sends_again=False)
    report = LinkReport(1, "main", 5600, corrects=True, dropped=0.05, burst=1.0)
    forecast.report(report, 0.0)
    assert forecast.loss == pytest.approx(0.05)
    for bad in (
        {"dropped": math.nan}, {"dropped": 1.5}, {"dropped": -1.0}, {"burst": math.inf},
        {"burst": 0.5}, {"corrects": False, "dropped": 0.9},
    ):  # fmt: skip
        forecast.report(replace(report, **bad), 1.0)  # type: ignore[arg-type]
    assert forecast.loss == pytest.approx(0.05) and forecast.burst == pytest.approx(1.0)
    for now_s in range(1, 40):
        forecast.report(replace(report, dropped=0.0, burst=None), float(now_s))
    assert forecast.loss < 1e-4
