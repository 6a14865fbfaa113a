"""The receiver hands out only what was sent, with its capture time, and counts everything else."""

import random
import socket
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import av
import numpy as np
import pytest
from numbered_flight import capture_ns, encoded, number_in, packets, stamped
from receiving import Receiver
from waiting import eventually

from ground_station.stream import rtp
from ground_station.stream.assembly import Assembly, ReceivedFrame
from ground_station.stream.counters import Counters
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import StreamError

FRAMES = 45
MS = 1_000_000
STREAMS = Path(__file__).parents[3] / "shared/data/streams"


def flight_units() -> list[bytes]:
    return [stamped(unit, index) for index, unit in enumerate(encoded(FRAMES))]


@cache
def without_loss() -> list[np.ndarray]:
    codec = av.CodecContext.create("h264", "r")
    decoded = [frame for unit in encoded(FRAMES) for frame in codec.decode(av.Packet(unit))]
    return [frame.to_ndarray(format="gray") for frame in [*decoded, *codec.decode(None)]]


class Stream:
    """One stream's assembly, whose only clock is its packets' arrival: one a millisecond."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.assembly = Assembly(77, self.counters)
        self.now_ns = 0

    def frames(self, datagrams: Sequence[bytes]) -> list[ReceivedFrame]:
        """What comes of them; at their end, of what waits for missing ones, too."""
        frames: list[ReceivedFrame] = []
        for datagram in datagrams:
            self.now_ns += MS
            packet = rtp.parse(datagram, self.now_ns)
            assert packet is not None
            frames += self.assembly.push(packet)
            frames += self.assembly.expire(self.now_ns)
        self.now_ns += 50 * MS
        frames += self.assembly.expire(self.now_ns)
        c = self.counters
        assert c.access_units == c.decoded + c.withheld + c.failed + c.unstamped
        return frames


def numbers(frames: Sequence[ReceivedFrame]) -> list[int]:
    """Those of the frames, which their pictures show, too."""
    assert [number_in(frame.image) for frame in frames] == [frame.sequence for frame in frames]
    return [frame.sequence for frame in frames]


def test_every_frame_comes_with_its_own_picture_and_capture_time() -> None:
    with Receiver(0, queue_frames=FRAMES) as receiver:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number, datagram in enumerate(packets(flight_units())):
                sender.sendto(datagram, ("127.0.0.1", receiver.port))
                # No faster than it is taken: the socket's buffer may be small.
                eventually(lambda: number - receiver.counters.packets < 60)  # noqa: B023
        frames = [frame for _ in range(FRAMES) if (frame := receiver.get(30.0)) is not None]
        assert numbers(frames) == list(range(FRAMES))
        assert [frame.time_ns for frame in frames] == [capture_ns(i) for i in range(FRAMES)]
        assert all(frame.clock_ns == frame.time_ns + 5 for frame in frames)
        assert all(frame.ssrc == 77 for frame in frames) and receiver.ssrc == 77
        for frame, picture in zip(frames, without_loss(), strict=True):
            assert np.array_equal(frame.image, picture)
        counters = receiver.counters
        assert counters.decoded == counters.access_units == FRAMES
        assert counters.packets_lost == counters.withheld == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("share", [0.002, 0.02])
def test_no_frame_painted_over_a_loss_is_handed_out(seed: int, share: float) -> None:
    rng, stream = random.Random(seed), Stream()
    datagrams = packets(flight_units())
    kept = [d for number, d in enumerate(datagrams) if number < 2 or rng.random() >= share]
    frames = stream.frames(kept)
    for frame in frames:
        assert np.array_equal(frame.image, without_loss()[frame.sequence]), frame.sequence
    assert stream.counters.packets == len(kept)
    assert stream.counters.decoded == len(frames)
    assert stream.counters.withheld > 0 or len(kept) == len(datagrams)


@pytest.mark.parametrize("delimiter", [b"", b"\x00\x00\x00\x01\x09\xf0"])
@pytest.mark.parametrize("part", ["first", "middle", "last", "whole"])
def test_after_a_loss_frames_come_again_from_the_next_idr(part: str, delimiter: bytes) -> None:
    units = [delimiter + unit for unit in flight_units()]
    datagrams = packets(units)
    begin, end = len(packets(units[:5])), len(packets(units[:6]))  # the packets of frame 5
    assert end - begin >= 3
    lost = {
        "first": range(begin, begin + 1),
        "middle": range(begin + 1, begin + 2),
        "last": range(end - 1, end),
        "whole": range(begin, end),
    }[part]
    stream = Stream()
    frames = stream.frames([d for number, d in enumerate(datagrams) if number not in lost])
    assert numbers(frames) == [*range(5), *range(15, 45)]
    assert stream.counters.packets_lost == len(lost)
    assert stream.counters.withheld == (9 if part == "whole" else 10)


def test_a_receiver_that_starts_late_begins_with_an_idr() -> None:
    stream = Stream()
    assert numbers(stream.frames(packets(flight_units()[7:]))) == list(range(15, 45))
    assert stream.counters.withheld == 8


def test_hostile_access_units_of_the_own_stream_do_not_end_it() -> None:
    rng = random.Random(4)
    units = flight_units()
    noise = [b"\x00\x00\x01\x65" + rng.randbytes(900) for _ in range(10)]
    noise += [units[0][:40] + rng.randbytes(400) for _ in range(10)]
    stream = Stream()
    frames = stream.frames(packets([*units[:5], *noise, *units]))
    assert numbers(frames[-FRAMES:]) == list(range(FRAMES))
    assert stream.counters.access_units == 25 + FRAMES


def test_frames_without_capture_time_are_not_handed_out_but_counted() -> None:
    stream = Stream()
    assert stream.frames(packets(list(encoded(FRAMES)))) == []
    assert stream.counters.unstamped == FRAMES


def test_a_real_cameras_stream_gives_a_picture_for_each_access_unit() -> None:
    path = STREAMS / "tello.h264"
    if not path.is_file():
        pytest.skip("shared/data/streams is not here")
    with av.open(str(path)) as container:
        units = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    sets = {annexb.NAL_SPS, annexb.NAL_PPS}
    start = next(i for i, unit in enumerate(units) if sets <= {*annexb.nal_types(unit)})
    stamps = [stamped(unit, index) for index, unit in enumerate(units[start : start + 60])]
    stream = Stream()
    frames = stream.frames(packets(stamps))
    assert [frame.sequence for frame in frames] == list(range(len(stamps)))
    assert stream.counters.failed == 0


def test_a_host_that_is_not_ours_is_one_line() -> None:
    with pytest.raises(StreamError, match=r"192\.0\.2\.1"):
        Receiver(0, "192.0.2.1")


def test_a_stream_without_parameter_sets_is_said_in_one_line() -> None:
    path = STREAMS / "tello-no-parameter-sets.h264"
    if not path.is_file():
        pytest.skip("shared/data/streams is not here")
    datagrams = packets([annexb.START_CODE + nal for nal in annexb.nal_units(path.read_bytes())])
    stream = Stream()
    stream.frames(datagrams[:100])
    assert stream.assembly.problem is None
    stream.now_ns += 3_000 * MS
    assert stream.frames(datagrams[100:200]) == []
    problem = stream.assembly.problem
    assert problem is not None and "no parameter sets" in problem and "\n" not in problem
    # And it recovers: a stream that has them is shown.
    assert stream.frames(packets(flight_units(), first=20_000))
    assert stream.assembly.problem is None


def test_a_stream_of_which_half_is_lost_is_not_called_one_without_parameter_sets() -> None:
    stream = Stream()
    came = [d for k, d in enumerate(packets(flight_units())) if k % 4 in (1, 2)]
    assert not stream.frames(came[:-1])
    stream.now_ns += 3_000 * MS
    assert not stream.frames(came[-1:])
    problem = stream.assembly.problem
    assert problem is not None and "were lost or came too late" in problem
    assert "parameter sets" not in problem and "\n" not in problem


def test_an_exposure_that_cannot_be_is_not_passed_on() -> None:
    told = [0.004, None, float("nan"), -0.01, 0.0, 5.0, 1.0]
    units = [
        stamped(unit, index, exposure_s)
        for index, (unit, exposure_s) in enumerate(zip(encoded(FRAMES), told, strict=False))
    ]
    assert [frame.exposure_s for frame in Stream().frames(packets(units))] == [
        pytest.approx(0.004), None, None, None, None, None, 1.0
    ]  # fmt: skip
