"""Past a loss the decoder goes on, and what is not marked is the picture that was sent."""

from __future__ import annotations

import random
from collections.abc import Sequence
from functools import cache

import av
import numpy as np
import pytest
from numbered_flight import HEIGHT_PX, WIDTH_PX, capture_ns, encoded, packets, stamped

from ground_station.arrays import U8
from ground_station.recording.h264 import grey
from ground_station.stream import damage, rtp
from ground_station.stream.assembly import Assembly, ReceivedFrame, Stamps
from ground_station.stream.counters import Counters
from ground_station.stream.damage import parameter_sets, slice_header, with_frame_num
from pi_firmware.wire import annexb, sei

FRAMES = 40
CABAC = "cabac=1"
VARIETY = "cabac=1:partitions=all:ref=3:subme=6:8x8dct=1:weightp=2"


@cache
def units(slices: int = 1, more: str = CABAC) -> list[bytes]:
    made = encoded(FRAMES, slices=slices, more=more)
    return [stamped(unit, index) for index, unit in enumerate(made)]


@cache
def truth(slices: int = 1, more: str = CABAC) -> list[U8]:
    """The pictures of these units."""
    return pictures(units(slices, more))


def pictures(sent: Sequence[bytes]) -> list[U8]:
    codec = av.CodecContext.create("h264", "r")
    decoded = [frame for unit in sent for frame in codec.decode(av.Packet(unit))]
    return [grey(frame) for frame in [*decoded, *codec.decode(None)]]


def received(
    datagrams: Sequence[bytes], lost: Sequence[int]
) -> tuple[list[ReceivedFrame], Counters]:
    counters = Counters()
    assembly = Assembly(77, counters)
    frames: list[ReceivedFrame] = []
    for number, datagram in enumerate(datagrams):
        if number not in lost:
            packet = rtp.parse(datagram, number * 1_000_000)
            assert packet is not None
            frames += assembly.push(packet)
            frames += assembly.expire(packet.arrival_ns + 31_000_000)
    return frames, counters


def is_true(frame: ReceivedFrame, sent: U8) -> bool:
    """Whether a frame is what was sent, where it does not say that it is damaged."""
    if frame.damaged is None:
        return bool(np.array_equal(frame.image, sent))
    assert frame.damaged.shape == (HEIGHT_PX // 16, WIDTH_PX // 16)
    damaged = np.repeat(np.repeat(frame.damaged, 16, axis=0), 16, axis=1)
    return bool((frame.image == sent)[~damaged].all())


@pytest.mark.parametrize(("slices", "more"), [(1, CABAC), (4, CABAC), (1, VARIETY)])
@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_not_marked_is_what_was_sent(seed: int, slices: int, more: str) -> None:
    sent = units(slices, more)
    datagrams = packets(sent, mtu_bytes=200)
    draw = random.Random(seed)
    lost = [number for number in range(20, len(datagrams) - 1) if draw.random() < 0.01]
    frames, counters = received(datagrams, lost)
    assert counters.packets_lost == len(lost) > 0
    for frame in frames:
        assert is_true(frame, truth(slices, more)[frame.sequence]), frame.sequence
    damaged = [frame.damaged for frame in frames if frame.damaged is not None]
    assert len(damaged) == counters.damaged > 0
    assert len(frames) == counters.received
    parts = counters.received + counters.withheld + counters.failed + counters.unstamped
    assert counters.access_units == parts


def in_frame(sent: Sequence[bytes], index: int) -> range:
    """The numbers of its packets."""
    return range(len(packets(sent[:index])), len(packets(sent[: index + 1])))


def test_a_cut_slice_damages_from_there_on_and_an_idr_heals_it() -> None:
    sent = units()
    last = in_frame(sent, 5)[-1]
    frames, counters = received(packets(sent), [last])
    assert [frame.sequence for frame in frames] == list(range(FRAMES))
    by_number = {frame.sequence: frame.damaged for frame in frames}
    hit = by_number[5]
    assert hit is not None and not hit[:10].any() and hit[-1].all()
    assert all(by_number[n] is None for n in (*range(5), *range(15, FRAMES)))
    shares = [damaged.mean() for n in range(5, 15) if (damaged := by_number[n]) is not None]
    assert len(shares) == 10 and shares[-1] >= shares[0] > 0  # motion carries it on
    assert counters.damaged == 10 and counters.withheld == 0


@pytest.mark.parametrize("more", [CABAC, VARIETY, "cabac=1:partitions=none:deblock=3"])
@pytest.mark.parametrize("part", [0.6, 0.8])
def test_motion_carries_damage_on_no_further_than_is_marked(part: float, more: str) -> None:
    sent = units(more=more)
    begin = len(packets(sent[:2], mtu_bytes=100))
    hit = len(packets(sent[:3], mtu_bytes=100)) - begin
    frames, _ = received(packets(sent, mtu_bytes=100), [begin + int(part * hit)])
    by_number = {frame.sequence: frame for frame in frames if frame.damaged is not None}
    assert set(by_number) >= {2, 3, 4}
    for number, frame in by_number.items():
        assert is_true(frame, truth(more=more)[number]), number


def test_a_lost_sei_costs_nothing_once_the_clocks_are_known() -> None:
    sent = units()
    lost = [in_frame(sent, 1)[0], in_frame(sent, 5)[0], in_frame(sent, 6)[0]]
    frames, counters = received(packets(sent), lost)
    assert [frame.sequence for frame in frames] == [n for n in range(FRAMES) if n != 1]
    assert counters.unstamped == 1 and counters.damaged == counters.withheld == 0
    for frame in frames:
        off_ns = 0 if frame.sequence not in (5, 6) else 2_000_000
        assert abs(frame.time_ns - capture_ns(frame.sequence)) <= off_ns
        told = sei.find(frame.access_unit)
        assert told is not None and (told.sequence, told.time_ns) == (frame.sequence, frame.time_ns)


def info(sequence: int, time_ns: int) -> sei.FrameInfo:
    return sei.FrameInfo(sequence, time_ns, time_ns + 5, 7.0, 1.0)


def test_a_stamp_is_estimated_by_the_rtp_clock_where_that_is_certain() -> None:
    stamps = Stamps()
    stamps.take(0xFFFFFFFF - 2999, info(7, 10**9))
    assert stamps.estimate(0) is None  # of one frame nothing can be told
    stamps.take(0, info(8, 10**9 + 33_400_000))
    next_one = stamps.estimate(3000)
    assert next_one is not None and next_one.sequence == 9
    assert next_one.time_ns == 10**9 + 33_400_000 + 33_333_333 == next_one.clock_ns - 5
    after_one = stamps.estimate(6010)  # one in between that the gate held back
    assert after_one is not None and after_one.sequence == 10
    assert stamps.estimate(4000) is None  # between two frames
    assert stamps.estimate(0) is stamps.estimate(90_000) is None  # none, and too far
    stamps.take(3000, info(9, 10**9 + 90_000_000))  # the camera's clock is another one
    assert stamps.estimate(6000) is None
    stamps.take(6000, info(0, 10**9 + 123_300_000))  # a session begins
    assert stamps.estimate(9000) is None


@pytest.mark.parametrize("part", ["begin of its slice", "all of it"])
def test_after_a_whole_picture_all_is_withheld_up_to_the_next_idr(part: str) -> None:
    sent = units()
    hit = in_frame(sent, 5)
    frames, counters = received(packets(sent), [hit[1]] if part != "all of it" else [*hit])
    assert [frame.sequence for frame in frames] == [*range(5), *range(15, FRAMES)]
    assert counters.damaged == 0 and counters.withheld == 15 - 5 - (part == "all of it")


def test_two_idrs_in_a_row_of_which_one_is_lost_are_told_from_none() -> None:
    """Both count their pictures from 0: only the payload's own number shows the gap."""
    one = [stamped(encoded(1, more="cabac=1:keyint=1")[0], 0)]
    sent = [*one, stamped(encoded(FRAMES, more=CABAC)[0], 1)]
    sent += [stamped(unit, n + 1) for n, unit in enumerate(encoded(FRAMES, more=CABAC)) if n]
    frames, _ = received(packets(sent), [*in_frame(sent, 1)])
    assert [frame.sequence for frame in frames] == [0, *range(16, FRAMES + 1)]


@pytest.mark.parametrize("lost", [(0,), (1,), (0, 1), (0, 1, 2)])
def test_parameter_sets_that_are_known_need_not_come_again(lost: tuple[int, ...]) -> None:
    sent = units()
    hit = in_frame(sent, 15)
    frames, counters = received(packets(sent), [hit[n] for n in lost])
    assert [frame.sequence for frame in frames] == list(range(FRAMES))
    assert counters.decoded == FRAMES and counters.idrs == 3
    assert all(is_true(frame, truth()[frame.sequence]) for frame in frames)
    # A recording may begin with it.
    assert len(pictures([frames[15].access_unit])) == 1


def test_other_parameter_sets_are_not_replaced_by_known_ones() -> None:
    sent = [*units()[:15], *units(more=VARIETY)[15:]]
    hit = in_frame(sent, 15)
    frames, counters = received(packets(sent), [hit[1]])
    assert [frame.sequence for frame in frames] == [*range(15), *range(30, FRAMES)]
    assert counters.withheld == 15


def test_an_idr_that_is_cut_shows_what_of_it_came() -> None:
    sent = units()
    frames, _ = received(packets(sent), [in_frame(sent, 5)[1], in_frame(sent, 15)[-1]])
    assert [frame.sequence for frame in frames] == [*range(5), *range(15, FRAMES)]
    assert all(is_true(frame, truth()[frame.sequence]) for frame in frames)
    assert [frame.damaged is None for frame in frames] == [True] * 5 + [False] * 15 + [True] * 10


def test_a_last_byte_that_says_nothing_of_the_picture_is_not_missed() -> None:
    """Of a slice's end, what closes arithmetic coding may stand alone in its last packet."""
    sent = units()
    sets = parameter_sets(sent[0])
    assert sets is not None
    free = []
    for number in range(1, 15):
        missing = damage.missing_rows(sent[number][:-1], sent[0], sets)
        if missing is not None and not missing.any():
            free.append(number)
    assert free
    cut = [unit[:-1] if number in free else unit for number, unit in enumerate(sent)]
    assert all(np.array_equal(a, b) for a, b in zip(pictures(cut), truth(), strict=True))


def test_a_stream_without_cabac_is_withheld() -> None:
    """FFmpeg carries what it had read of a macroblock that was cut into the next picture."""
    sent = units(more="cabac=0")
    frames, counters = received(packets(sent), [in_frame(sent, 5)[-1]])
    assert [frame.sequence for frame in frames] == [*range(5), *range(15, FRAMES)]
    assert counters.damaged == 0


def test_headers_are_read_and_renumbered() -> None:
    sent = units()
    sets = parameter_sets(sent[0])
    assert sets is not None and (sets.width, sets.height, sets.references) == (40, 30, 1)
    for index, unit in enumerate(sent):
        (nal,) = (n for n in annexb.nal_units(unit) if annexb.nal_type(n) in (1, 5))
        header = slice_header(nal, sets)
        assert header is not None and header.first_macroblock == 0
        assert header.frame_num == index % 15 and header.idr == (index % 15 == 0)
        again = slice_header(with_frame_num(nal, header, sets, 9), sets)
        assert again is not None and again.frame_num == 9
        assert with_frame_num(nal, header, sets, header.frame_num) == nal


@pytest.mark.parametrize(
    "data",
    [b"", b"\0\0\1\x67", b"\0\0\1\x67\x64\0\x1e\0\0\1\x68\xff", b"\0\0\1\x67" + b"\0\1" * 40],
)
def test_headers_that_cannot_be_read_are_none(data: bytes) -> None:
    assert parameter_sets(data) is None
    sets = parameter_sets(units()[0])
    assert sets is not None
    assert slice_header(b"\x61", sets) is slice_header(b"\x61\0", sets) is None
    assert slice_header(b"\x61" + b"\0" * 90, sets) is None
