"""The payload's own link, and the program that flies, send again what an impaired link lost."""

from __future__ import annotations

import importlib.util
import json
import random
import socket
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import pytest
from impaired_link import CLEAN, ImpairedLink, Impairment
from numbered_flight import (
    GOP,
    capture_ns,
    encoded,
    number_in,
    packets,
    stamped,
    start_payload,
)
from recovering_link import sent_again
from waiting import eventually

from ground_station.stream import rtp
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.feedback import Feedback
from ground_station.stream.multi_stream import MultiStreamReceiver, Stream
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware import gstreamer
from pi_firmware import retransmission as payloads
from pi_firmware.link import Link
from pi_firmware.retransmission import Budget, rtx_ssrc
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import rtcp
from pi_firmware.wire.messages import LinkReport
from pi_firmware.wire.srtcp import SrtcpProtector

KEY = bytes(range(30))
LIMIT_S = 30.0


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


def numbers(frames: Sequence[ReceivedFrame]) -> list[int]:
    sequences = [frame.sequence for frame in frames]
    assert [number_in(frame.image) for frame in frames] == sequences
    return sequences


def test_the_payloads_own_link_sends_again_what_was_lost() -> None:
    sizes: list[int] = []
    with flying(key=KEY) as flown:
        flown.air._tap = lambda datagram, lost: sizes.append(len(datagram))
        send(flown, 5)
        eventually(lambda: len(flown.frames) == 5)
        flown.stream.retransmits(flown.link.rtx_ssrc, 0.001)
        flown.air.impair(Impairment(loss=0.05, delay_s=0.005))
        send(flown, 70, first=5)
        eventually(lambda: flown.air.idle)
        flown.air.impair(CLEAN)
        send(flown, 20, first=75)  # in which there is an IDR
        eventually(lambda: flown.frames[-1].sequence == 94)
        counters = flown.stream.counters
        # A machine that is busy with other things answers some of it too late.
        assert counters.packets_recovered >= 0.7 * flown.air.counts.lost > 10
        assert counters.packets_recovered + counters.packets_lost >= counters.packets_asked
        assert len(numbers(flown.frames)) == 95 - counters.withheld >= 70
        assert counters.withheld == 0 or counters.packets_lost > 0
        assert flown.receiver.counters.refused == flown.receiver.counters.other_streams == 0
    assert max(sizes) == 600  # the link's MTU


LOSSY = LinkReport(1, "main", 5600, ssrc=77, corrects=True, dropped=0.05, burst=1.0)


def test_the_payloads_own_link_corrects_what_was_lost_and_a_clean_one_carries_no_more() -> None:
    with flying(key=KEY, history_s=0.0) as flown:
        kinds: Counter[int] = Counter()
        sizes: list[int] = []

        def tap(datagram: bytes, _: bool) -> None:
            kinds[datagram[1] & 0x7F] += 1
            sizes.append(len(datagram))

        flown.air._tap = tap
        flown.link.report(replace(LOSSY, dropped=0.0), 0.0)
        send(flown, 5)
        eventually(lambda: len(flown.frames) == 5)
        assert set(kinds) == {96}
        flown.stream.corrects(flown.link.correction_ssrc)
        flown.link.report(LOSSY, 100.0)
        flown.air.impair(Impairment(loss=0.05))
        send(flown, 55, first=5)
        eventually(lambda: flown.air.idle)
        flown.air.impair(CLEAN)
        assert 0.1 < flown.link.report(LOSSY, 100.0) < 1.1
        send(flown, 20, first=60)
        eventually(lambda: flown.frames[-1].sequence == 79)
        counters, link = flown.stream.counters, flown.air.counts
        assert len(numbers(flown.frames)) == 80 - counters.withheld >= 50
        assert counters.withheld == 0 or counters.packets_lost > 0
        assert counters.packets_corrected >= 10 > 5 * counters.packets_lost
        assert kinds[98] > counters.corrections > 0
        assert counters.packets + counters.corrections == link.passed
        assert max(sizes) <= 600
        port = flown.receiver.counters
        assert port.refused == port.other_streams == port.garbage == 0
        # The losses are over: so are the corrections.
        flown.link.report(replace(LOSSY, dropped=0.0), 200.0)
        kinds.clear()
        send(flown, 3, first=80)
        eventually(lambda: flown.frames[-1].sequence == 82)
        assert set(kinds) == {96}


def test_a_nack_without_the_key_costs_nothing_and_with_it_no_more_than_the_budget() -> None:
    with flying(key=KEY) as flown:
        send(flown, 20)
        eventually(lambda: len(flown.frames) == 20)
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
            eventually(lambda: flown.air.counts.received > came)
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
        eventually(lambda: len(flown.frames) == 5)
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

            eventually(asked_and_sent)


def _heard(flown: Flown) -> list[rtp.Packet]:
    """The newest packet, by the receiver's own account of numbers."""
    (reorderer,) = [flown.stream._assembly._reorderer]
    newest = (reorderer._next - 1) & 0xFFFF
    return [rtp.Packet(newest, 0, 77, False, b"x", 0)]


def test_the_ssrc_of_what_is_sent_again_is_another_and_never_zero() -> None:
    for ssrc in (1, 77, 0x80000000, 0xFFFFFFFF):
        assert 0 < rtx_ssrc(ssrc) <= 0xFFFFFFFF and rtx_ssrc(ssrc) != ssrc


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
        eventually(lambda: receiver.stream_of("one"))
        stream = receiver.stream_of("one")
        assert stream is not None
        stream.retransmits(99, 0.001)
        for datagram in (datagrams[2], *datagrams[4:]):
            sender.sendto(datagram, to)
        assert rtcp.asked_for(sender.recv(1500), 77) == [0]
        sender.sendto(sent_again(datagrams[3], ssrc=98), to)  # another's
        sender.sendto(sent_again(datagrams[3]), to)
        eventually(lambda: len(frames) == 6)
        assert receiver.counters.other_streams == 1


@pytest.mark.parametrize("way", ["link.correction=0", "link.history_s=0"])
def test_a_flight_over_a_lossy_link_shows_nearly_all_of_its_frames(way: str) -> None:
    """The program that flies, its telemetry, and what it announces in it."""
    seconds = 6
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
            way,
            f"telemetry.connect={json.dumps(listener.endpoints)}",
        )
        try:
            _, err = process.communicate(timeout=LIMIT_S + seconds)
        finally:
            process.kill()
        assert process.returncode == 0, err
        eventually(lambda: air.idle)
        stream = receiver.stream_of("blimp-1")
        assert stream is not None
        eventually(lambda: _datagrams(stream) == air.counts.passed)
        state = listener.state("blimp-1")
        counters, link, asked = stream.counters, air.counts, air.returned
    assert state is not None and state.health is not None
    # The first two seconds it is not known yet that anything comes again, or what is lost.
    late = [sequence for sequence in shown_at if sequence >= 60]
    if "history_s" in way:
        assert state.health.correction_ssrc == stream.correction_ssrc is not None
        assert stream.rtx_ssrc is None and len(late) >= 0.6 * (30 * seconds - 60)
        assert counters.packets_corrected > counters.packets_lost
        assert asked == counters.retransmissions == 0  # as of an older payload
        return
    assert state.health.rtx_ssrc == stream.rtx_ssrc is not None
    assert stream.correction_ssrc is None and len(late) >= 0.95 * (30 * seconds - 60)
    assert counters.packets_recovered > 0.5 * link.lost
    assert counters.packets_lost <= 0.5 * link.lost


def _datagrams(stream: Stream) -> int:
    counters = stream.counters
    return counters.packets + counters.retransmissions + counters.corrections


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
