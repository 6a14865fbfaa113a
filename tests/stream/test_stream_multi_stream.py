"""Several streams on one port: each whole by itself, none waits for another, strangers counted."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Iterable, Iterator

import pytest
from numbered_flight import GOP, encoded, number_in, packets, stamped
from srtp_sender import SrtpSender
from waiting import eventually

from ground_station.stream import multi_stream
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.multi_stream import MultiStreamReceiver
from pi_firmware.wire.errors import StreamError

FRAMES = 45
LIMIT_S = 30.0


def units() -> list[bytes]:
    return [stamped(unit, index) for index, unit in enumerate(encoded(FRAMES))]


class Port:
    """A receiver with whatever it gave out; `names` says whose a stream is."""

    def __init__(self, names: dict[int, str], **given: object) -> None:
        self.names = names
        self.frames: dict[str, list[ReceivedFrame]] = {}
        self.held = threading.Event()
        self.held.set()
        self.receiver = MultiStreamReceiver(
            0,
            owner=self._owner,
            on_frame=self._take,
            **given,  # type: ignore[arg-type]
        )

    def __enter__(self) -> Port:
        return self

    def __exit__(self, *_: object) -> None:
        self.held.set()
        self.receiver.close()

    def _owner(self, ssrc: int, key_owner: str | None, age_s: float) -> str | None:
        return self.names.get(ssrc)

    def _take(self, payload_id: str, frame: ReceivedFrame) -> None:
        if payload_id == "slow":
            self.held.wait(LIMIT_S)
        self.frames.setdefault(payload_id, []).append(frame)

    def send(self, datagrams: Iterable[bytes]) -> None:
        """No faster than a receiver with a small buffer takes them."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number, datagram in enumerate(datagrams, start=1):
                sender.sendto(datagram, ("127.0.0.1", self.receiver.port))
                if number % 40 == 0:
                    time.sleep(0.02)

    def shown(self, payload_id: str) -> list[int]:
        """The numbers of its frames, which their pictures show, too."""
        frames = list(self.frames.get(payload_id, []))
        numbers = [frame.sequence for frame in frames]
        assert [number_in(frame.image) for frame in frames] == numbers
        return numbers


@pytest.fixture
def one_and_two() -> Iterator[Port]:
    with Port({1: "one", 2: "two"}) as port:
        yield port


def test_two_streams_are_told_apart_and_each_counts_its_own(one_and_two: Port) -> None:
    one, two = packets(units(), ssrc=1), packets(units(), ssrc=2)
    del two[100]
    one_and_two.send(
        datagram for pair in zip(one, [*two, two[-1]], strict=True) for datagram in pair
    )
    eventually(lambda: len(one_and_two.shown("one")) == FRAMES)
    receiver = one_and_two.receiver
    first, second = receiver.stream_of("one"), receiver.stream_of("two")
    assert first is not None and second is not None
    eventually(lambda: second.counters.packets == len(two) + 1)
    assert (first.ssrc, second.ssrc) == (1, 2)
    assert first.counters.packets == len(one) and first.counters.packets_lost == 0
    assert second.counters.packets_lost == 1 and second.counters.withheld > 0
    assert set(one_and_two.shown("two")) < set(range(FRAMES))
    assert receiver.counters.garbage == receiver.counters.other_streams == 0


def test_one_that_is_not_taken_does_not_hold_up_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(multi_stream, "_QUEUE_PACKETS", 50)
    with Port({1: "slow", 2: "two"}) as port:
        port.held.clear()
        slow, two = packets(units(), ssrc=1), packets(units(), ssrc=2)
        port.send(slow)

        def taken() -> int:
            known = port.receiver.stream_of("two")
            return known.counters.packets if known is not None else 0

        for number, datagram in enumerate(two):
            eventually(lambda: taken() > number - 20)  # noqa: B023  # no more than fits
            port.send([datagram])
        eventually(lambda: port.shown("two") == [*range(FRAMES)])
        stream = port.receiver.stream_of("slow")
        assert stream is not None
        # What does not fit is thrown away and counted, and no memory grows with it.
        counters = stream.counters
        assert counters.overrun > 0
        port.held.set()
        eventually(lambda: stream.counters.packets + stream.counters.overrun == len(slow))
        port.shown("slow")


def test_a_stream_is_held_until_somebody_vouches_for_it() -> None:
    with Port({}) as port:
        port.send(packets(units()[:20], ssrc=9))
        time.sleep(0.3)
        assert port.frames == {} and port.receiver.streams() == []
        assert port.receiver.behind(9) and not port.receiver.behind(8)
        port.names[9] = "late"
        port.send(packets(units(), ssrc=9)[len(packets(units()[:20], ssrc=9)) :])
        eventually(lambda: port.shown("late") == [*range(FRAMES)])
        eventually(lambda: not port.receiver.behind(9))


@pytest.mark.parametrize("age", [3, 1])
def test_what_was_sent_before_the_receiver_was_there_is_not_shown_once_more(age: int) -> None:
    """Recorded from the air: `age` groups of half a second lie between it and what is sent now."""
    key = random.Random(6).randbytes(30)
    sent = [stamped(unit, index) for index, unit in enumerate(encoded(5 * GOP))]
    with SrtpSender(key) as sender:
        made = sender.protect(packets(sent, ssrc=9))

    def of(first: int, end: int) -> list[bytes]:
        return made[len(packets(sent[:first], ssrc=9)) : len(packets(sent[:end], ssrc=9))]

    began = 4 * GOP
    recorded = of((3 - age) * GOP, began - age * GOP - GOP // 3)
    now = of(began, 5 * GOP)
    with Port({}, srtp_keys={"one": key}) as port:
        port.send(recorded)
        port.send(now[: len(now) // 2])
        port.send(recorded)
        time.sleep(0.3)
        port.names[9] = "one"
        port.send([*recorded, *now[len(now) // 2 :]])
        eventually(lambda: port.shown("one") == [*range(began, 5 * GOP)])
        port.send(recorded)
        time.sleep(0.3)
        assert port.shown("one") == [*range(began, 5 * GOP)]
        assert port.receiver.counters.replayed >= len(recorded)


@pytest.mark.parametrize("keyed", [False, True], ids=["plain", "encrypted"])
def test_a_stream_that_stood_still_before_it_was_taken_is_whole(keyed: bool) -> None:
    """A radio that begins with a gap; a replay that waited for an answer."""
    key = random.Random(6).randbytes(30)
    sent = packets(units(), ssrc=9)
    if keyed:
        with SrtpSender(key) as sender:
            sent = sender.protect(sent)
    with Port({}, srtp_keys={"one": key} if keyed else None) as port:
        port.send(sent[:20])
        time.sleep(0.8)
        port.send(sent[20:])
        port.names[9] = "one"
        eventually(lambda: port.shown("one") == [*range(FRAMES)])


def test_a_replay_whose_time_leaps_is_whole() -> None:
    """A stepped flight whose frames of a second in between were gated."""
    sent = [*units()[:1], *units()[2 * GOP :]]
    first, later = packets(sent[:1], ssrc=9), packets(sent, ssrc=9)
    for number, datagram in enumerate(later[len(first) :], start=len(first)):
        ticks = int.from_bytes(datagram[4:8]) + 90_000
        later[number] = datagram[:4] + ticks.to_bytes(4) + datagram[8:]
    with Port({}) as port:
        port.send(later)
        port.names[9] = "one"
        eventually(lambda: port.shown("one") == [0, *range(2 * GOP, FRAMES)])


def test_a_stream_taken_for_nobodys_goes_on_as_whose_it_is() -> None:
    with Port({9: "nobody"}) as port:
        sent = packets(units(), ssrc=9)
        port.send(sent[:100])
        eventually(lambda: port.shown("nobody"))
        port.names[9] = "one"
        eventually(lambda: port.receiver.stream_of("one"))
        port.send(sent[100:])
        eventually(lambda: len(port.shown("nobody")) + len(port.frames.get("one", [])) == FRAMES)
        assert port.shown("nobody") + port.shown("one") == [*range(FRAMES)]


def test_strangers_and_garbage_are_counted_and_bounded(one_and_two: Port) -> None:
    draw = random.Random(2)
    receiver, genuine = one_and_two.receiver, packets(units(), ssrc=1)
    noise = [draw.randbytes(draw.randint(0, 1400)) for _ in range(200)]
    many = [packets(units()[:1], ssrc=100 + k)[0] for k in range(100)]
    long = packets(units() * 3, ssrc=77)
    mixed = [*noise, *many, *long]
    draw.shuffle(mixed)
    one_and_two.send(
        datagram
        for k in range(max(len(mixed), len(genuine)))
        for datagram in (*mixed[k : k + 1], *genuine[k : k + 1])
    )
    eventually(lambda: one_and_two.shown("one") == [*range(FRAMES)])
    held = lambda: sum(len(c.packets) for c in receiver._candidates.values())  # noqa: E731

    def told() -> int:
        counted = receiver.counters
        return counted.garbage + counted.other_streams + held()

    eventually(lambda: told() == len(mixed))
    assert len(receiver._candidates) <= 8 and held() <= 8 * 512
    assert [stream.payload_id for stream in receiver.streams()] == ["one"]


def test_a_payload_has_one_stream_and_the_next_when_that_is_silent() -> None:
    with Port({1: "one", 2: "one"}) as port:
        earlier, later = packets(units(), ssrc=1), packets(units(), ssrc=2)
        half = len(earlier) // 2
        port.send(earlier[:half])
        port.send(
            datagram for pair in zip(earlier[half:], later, strict=False) for datagram in pair
        )
        eventually(lambda: len(port.shown("one")) == FRAMES)
        assert {frame.ssrc for frame in port.frames["one"]} == {1}
        time.sleep(0.6)
        port.send(later[len(earlier) - half :])
        eventually(lambda: len(port.frames["one"]) == 2 * FRAMES)
        assert port.shown("one") == [*range(FRAMES)] * 2
        (stream,) = port.receiver.streams()
        assert stream.ssrc == 2 and stream.counters.packets == len(later)


def test_with_keys_each_payload_is_its_own_and_nobody_elses() -> None:
    draw = random.Random(6)
    keys = {"one": draw.randbytes(30), "two": draw.randbytes(30)}
    plain = {1: packets(units(), ssrc=1), 2: packets(units(), ssrc=2)}
    with SrtpSender(keys["one"]) as first, SrtpSender(keys["two"]) as second:
        one, two = first.protect(plain[1]), second.protect(plain[2])
        stolen = first.protect(packets(units(), ssrc=3))
    # `two` announces the stream 3, which was made with the key of `one`.
    with Port({1: "one", 2: "two", 3: "two"}, srtp_keys=keys) as port:
        port.send(d for four in zip(one, two, plain[1], stolen, strict=True) for d in four)
        eventually(lambda: port.shown("one") == [*range(FRAMES)] == port.shown("two"))
        assert {frame.ssrc for frame in port.frames["two"]} == {2}
        eventually(lambda: port.receiver.counters.refused == len(plain[1]))
        assert port.receiver.encrypted and len(port.receiver.streams()) == 2


def test_a_payload_that_sends_with_anothers_ssrc_does_not_shut_it_out() -> None:
    draw = random.Random(6)
    keys = {"one": draw.randbytes(30), "two": draw.randbytes(30)}
    with SrtpSender(keys["one"]) as first, SrtpSender(keys["two"]) as second:
        squatting = first.protect(packets(units()[:3], ssrc=2))
        own = second.protect(packets(units(), ssrc=2))
    for before in (0, len(own) // 2):  # the owner's own first, or in the middle of them
        with Port({2: "two"}, srtp_keys=keys) as port:
            port.send([*own[:before], *squatting, *own[before:]])
            eventually(lambda: port.shown("two") == [*range(FRAMES)])
            (stream,) = port.receiver.streams()
            assert stream.counters.packets == len(own) and "one" not in port.frames


def test_there_are_only_so_many_streams_and_a_silent_one_gives_way() -> None:
    with Port({1: "one", 2: "two"}, max_streams=1) as port:
        port.send(packets(units(), ssrc=1))
        port.send(packets(units()[:2], ssrc=2))
        eventually(lambda: port.shown("one") == [*range(FRAMES)])
        eventually(lambda: port.shown("two") == [0, 1])  # once `one` was silent for 0.5 s
        assert [stream.payload_id for stream in port.receiver.streams()] == ["two"]


class Failing(Port):
    """Cannot take its first frames."""

    def _take(self, payload_id: str, frame: ReceivedFrame) -> None:
        if frame.sequence < 20:
            raise ValueError("no room")
        super()._take(payload_id, frame)


def test_what_fails_with_a_frame_ends_neither_stream() -> None:
    with Failing({1: "one"}) as port:
        port.send(packets(units(), ssrc=1))
        eventually(lambda: port.shown("one") == [*range(20, FRAMES)])
        assert port.receiver.failure == ""


def test_a_port_in_use_is_one_line(one_and_two: Port) -> None:
    with pytest.raises(StreamError, match="in use"):
        MultiStreamReceiver(
            one_and_two.receiver.port, owner=lambda *_: None, on_frame=lambda *_: None
        )
