"""The receiver hands out only what was sent, with its capture time, and counts everything else."""

import random
import socket
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from numbered_flight import capture_ns, encoded, number_in, packets, stamped
from receiving import Receiver
from srtp_sender import SrtpSender
from waiting import eventually

from ground_station.stream import rtp
from ground_station.stream.assembly import SETS_TIMEOUT_S, Assembly, ReceivedFrame
from ground_station.stream.counters import Counters
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import StreamError

FRAMES = 45
HELD = 8
"""Of strangers so many packets are kept for a while and not counted."""
STREAMS = Path(__file__).parents[3] / "shared/data/streams"


def flight_units() -> list[bytes]:
    return [stamped(unit, index) for index, unit in enumerate(encoded(FRAMES))]


def without_loss() -> list[np.ndarray]:
    codec = av.CodecContext.create("h264", "r")
    decoded = [frame for unit in encoded(FRAMES) for frame in codec.decode(av.Packet(unit))]
    return [frame.to_ndarray(format="gray") for frame in [*decoded, *codec.decode(None)]]


def send(datagrams: Iterable[bytes], receiver: Receiver) -> None:
    """Sends datagrams no faster than the receiver takes them: the socket's buffer may be small."""

    def taken() -> int:
        c = receiver.counters
        return c.packets + c.garbage + c.other_streams + c.refused + c.replayed + HELD

    before = taken()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number, datagram in enumerate(datagrams, start=1):
            sender.sendto(datagram, ("127.0.0.1", receiver.port))
            eventually(lambda: number - (taken() - before) < 60)  # noqa: B023


def all_frames(receiver: Receiver) -> list[ReceivedFrame]:
    frames = []
    while (frame := receiver.get(1.0)) is not None:  # a busy machine may be still for a moment
        frames.append(frame)
    return frames


def accounted(receiver: Receiver) -> bool:
    c = receiver.counters
    return c.access_units == c.decoded + c.withheld + c.failed + c.unstamped


def test_every_frame_comes_with_its_own_picture_and_capture_time() -> None:
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send(packets(flight_units()), receiver)
        frames = all_frames(receiver)
        assert [frame.sequence for frame in frames] == list(range(FRAMES))
        assert [number_in(frame.image) for frame in frames] == list(range(FRAMES))
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
    rng = random.Random(seed)
    datagrams = packets(flight_units())
    kept = [d for number, d in enumerate(datagrams) if number < 2 or rng.random() >= share]
    truth = without_loss()
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send(kept, receiver)
        frames = all_frames(receiver)
        for frame in frames:
            assert np.array_equal(frame.image, truth[frame.sequence]), frame.sequence
        counters = receiver.counters
        assert counters.packets == len(kept)
        assert counters.decoded == len(frames)
        assert accounted(receiver)
        assert counters.withheld > 0 or len(kept) == len(datagrams)


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
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send([d for number, d in enumerate(datagrams) if number not in lost], receiver)
        assert [frame.sequence for frame in all_frames(receiver)] == [*range(5), *range(15, 45)]
        counters = receiver.counters
        assert counters.packets_lost == len(lost)
        assert counters.withheld == (9 if part == "whole" else 10)


def test_a_receiver_that_starts_late_begins_with_an_idr() -> None:
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send(packets(flight_units()[7:]), receiver)
        assert [frame.sequence for frame in all_frames(receiver)] == list(range(15, 45))
        assert receiver.counters.withheld == 8


def test_garbage_is_counted_and_changes_nothing() -> None:
    rng = random.Random(9)
    genuine = packets(flight_units())
    garbage = [rng.randbytes(rng.randint(0, 1500)) for _ in range(300)]
    cut = [datagram[: rng.randint(0, 11)] for datagram in genuine[:50]]
    wrong_type = [datagram[:1] + b"\x21" + datagram[2:] for datagram in genuine[:50]]
    looks_right = [b"\x80\x60" + rng.randbytes(40) for _ in range(50)]
    mixed = [*garbage, *cut, *wrong_type, *looks_right]
    places = [(rng.uniform(0, len(genuine)), datagram) for datagram in mixed]
    ordered = sorted([*places, *enumerate(genuine)], key=lambda entry: entry[0])
    with Receiver(0, queue_frames=FRAMES, ssrc=77) as receiver:
        send([datagram for _, datagram in ordered], receiver)
        frames = all_frames(receiver)
        assert [frame.sequence for frame in frames] == list(range(FRAMES))
        assert [number_in(frame.image) for frame in frames] == list(range(FRAMES))
        counters = receiver.counters
        assert counters.packets == len(genuine)
        # Of the newest strangers a packet each is still held.
        assert len(mixed) - 8 <= counters.garbage + counters.other_streams <= len(mixed)
        assert counters.garbage >= 390 and counters.packets_lost == 0


def test_hostile_access_units_of_the_own_stream_do_not_end_it() -> None:
    rng = random.Random(4)
    units = flight_units()
    noise = [b"\x00\x00\x01\x65" + rng.randbytes(900) for _ in range(10)]
    noise += [units[0][:40] + rng.randbytes(400) for _ in range(10)]
    with Receiver(0, queue_frames=2 * FRAMES) as receiver:
        send(packets([*units[:5], *noise, *units]), receiver)
        eventually(lambda: receiver.counters.access_units == 25 + FRAMES)
        frames = all_frames(receiver)
        assert [frame.sequence for frame in frames[-FRAMES:]] == list(range(FRAMES))
        assert accounted(receiver)


def test_frames_without_capture_time_are_not_handed_out_but_counted() -> None:
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send(packets(list(encoded(FRAMES))), receiver)
        eventually(lambda: receiver.counters.unstamped == FRAMES)
        assert receiver.get(0.01) is None
        assert accounted(receiver)


def test_with_keys_a_known_payloads_stream_is_taken_and_no_other() -> None:
    rng = random.Random(6)
    keys = {"blimp-1": rng.randbytes(30), "blimp-2": rng.randbytes(30)}
    plain = packets(flight_units(), ssrc=1)
    with SrtpSender(keys["blimp-2"]) as own, SrtpSender(rng.randbytes(30)) as stranger:
        protected, strange = own.protect(plain), stranger.protect(plain)
    with Receiver(0, queue_frames=2 * FRAMES, srtp_keys=keys) as receiver:
        send([plain[0], strange[0], plain[1], strange[1]], receiver)
        eventually(lambda: receiver.counters.refused == 4)
        assert receiver.ssrc is None and receiver.payload_id is None
        mixed = zip(protected, protected, plain, strange, strict=True)
        send([datagram for four in mixed for datagram in four], receiver)
        frames = all_frames(receiver)
        assert [frame.sequence for frame in frames] == list(range(FRAMES))
        assert [number_in(frame.image) for frame in frames] == list(range(FRAMES))
        assert receiver.ssrc == 1 and receiver.payload_id == "blimp-2"
        counters = receiver.counters
        assert counters.packets == counters.replayed == len(protected)
        assert counters.refused == 4 + 2 * len(plain)
        assert counters.packets_lost == counters.garbage == counters.other_streams == 0


def test_without_keys_an_encrypted_stream_gives_no_frame() -> None:
    with SrtpSender(bytes(30)) as sender:
        protected = sender.protect(packets(flight_units()))
    with Receiver(0, queue_frames=FRAMES) as receiver:
        send(protected, receiver)
        assert receiver.get(0.2) is None and receiver.payload_id is None
        assert receiver.counters.decoded == receiver.counters.refused == 0


def test_a_real_cameras_stream_gives_a_picture_for_each_access_unit() -> None:
    path = STREAMS / "tello.h264"
    if not path.is_file():
        pytest.skip("shared/data/streams is not here")
    with av.open(str(path)) as container:
        units = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    start = next(i for i, unit in enumerate(units) if annexb.has_parameter_sets(unit))
    stamps = [stamped(unit, index) for index, unit in enumerate(units[start : start + 60])]
    with Receiver(0, queue_frames=60) as receiver:
        send(packets(stamps), receiver)
        frames = all_frames(receiver)
        assert receiver.counters.failed == 0
        assert [frame.sequence for frame in frames] == list(range(len(stamps)))


def test_a_port_in_use_is_one_line() -> None:
    with Receiver(0) as receiver, pytest.raises(StreamError) as caught:
        Receiver(receiver.port)
    assert str(receiver.port) in str(caught.value) and "in use" in str(caught.value)


def test_a_host_that_is_not_ours_is_one_line() -> None:
    with pytest.raises(StreamError, match=r"192\.0\.2\.1"):
        Receiver(0, "192.0.2.1")


def test_a_stream_without_parameter_sets_is_said_in_one_line() -> None:
    path = STREAMS / "tello-no-parameter-sets.h264"
    if not path.is_file():
        pytest.skip("shared/data/streams is not here")
    units = [annexb.START_CODE + nal for nal in annexb.nal_units(path.read_bytes())]
    with Receiver(0, queue_frames=FRAMES) as receiver:
        datagrams = packets(units)
        send(datagrams[:100], receiver)
        time.sleep(SETS_TIMEOUT_S)
        send(datagrams[100:200], receiver)
        eventually(lambda: bool(receiver.problem))
        assert "no parameter sets" in receiver.problem and "\n" not in receiver.problem
        # And it recovers: a stream that has them is shown.
        send(packets(flight_units(), first=20_000), receiver)
        eventually(lambda: not receiver.problem)
        assert receiver.get(1.0) is not None


def test_a_stream_of_which_half_is_lost_is_not_called_one_without_parameter_sets() -> None:
    # On the assembly, whose only clock is its packets' arrival: 30 frames a second for 0.5 s.
    parsed = (rtp.parse(datagram, 0) for datagram in packets(flight_units()))
    sent = [packet for packet in parsed if packet is not None]
    counters = Counters()
    assembly = Assembly(1, counters, sets_timeout_s=0.2)
    first = sent[0].timestamp
    for k, packet in enumerate(sent):
        arrival_ns = (packet.timestamp - first) * 1_000_000_000 // 90_000
        if k % 4 in (1, 2):
            assert not list(assembly.push(replace(packet, arrival_ns=arrival_ns)))
        assert not list(assembly.expire(arrival_ns))
    problem = assembly.problem
    assert problem is not None and "were lost or came too late" in problem
    assert "parameter sets" not in problem and "\n" not in problem


def test_an_exposure_that_cannot_be_is_not_passed_on() -> None:
    told = [0.004, None, float("nan"), -0.01, 0.0, 5.0, 1.0]
    units = [
        stamped(unit, index, exposure_s)
        for index, (unit, exposure_s) in enumerate(zip(encoded(FRAMES), told, strict=False))
    ]
    with Receiver(port=0, queue_frames=FRAMES) as receiver:
        send(packets(units), receiver)
        eventually(lambda: receiver.counters.decoded == len(told))
        frames = all_frames(receiver)
    assert [frame.sequence for frame in frames] == list(range(len(told)))
    assert [frame.exposure_s for frame in frames] == [
        pytest.approx(0.004), None, None, None, None, None, 1.0
    ]  # fmt: skip
