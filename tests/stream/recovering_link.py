"""A link that loses packets and a sender that fixes them, without a program or a clock.

Packets, what is asked for, what is sent again and corrections take half a round trip each and are
lost by the same draws; the ground's reports, one a second, come at once. Time goes on in steps of a
millisecond. All is drawn with a seed.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

from impaired_link import Impairment

from ground_station.stream import rtp
from ground_station.stream.arrivals import Arrivals
from ground_station.stream.correction import Correction
from ground_station.stream.counters import Counters
from ground_station.stream.rtp import AccessUnit
from pi_firmware.correction import Sender
from pi_firmware.settings import LinkSettings
from pi_firmware.wire import rtcp
from pi_firmware.wire.messages import LinkReport

MS = 1_000_000
RATE_HZ = 30


class Loss:
    """Which packets an impairment's loss and bursts take (Gilbert-Elliott)."""

    def __init__(self, does: Impairment, seed: int) -> None:
        self._does, self._draw, self._bad = does, random.Random(seed), False

    def takes(self) -> bool:
        """Whether the next packet is lost."""
        does, (turn, lost, burst) = self._does, (self._draw.random() for _ in range(3))
        self._bad = turn >= does.burst_end if self._bad else turn < does.burst_start
        return lost < does.loss or (self._bad and burst < does.burst_loss)


@dataclass
class Recovered:
    """What came out: access units with when, ms; the receiver's counters; datagrams by kind."""

    units: list[tuple[int, AccessUnit]] = field(default_factory=list)
    counters: Counters = field(default_factory=Counters)
    lost: int = 0
    nacks: int = 0
    again: int = 0
    sent_bytes: int = 0
    correction_bytes: int = 0


def fly(
    frames: Sequence[Sequence[bytes]],
    does: Impairment,
    *,
    round_trip_ms: int = 10,
    seed: int = 0,
    offered: bool = True,
    history_ms: int = 500,
    ssrc: int = 77,
    drop: Collection[int] = (),
    corrected: bool = False,
    link: LinkSettings = LinkSettings(),  # noqa: B008  # frozen
) -> Recovered:
    """Sends a frame's datagrams each 1/30 s; `offered`: what is missing is asked for.

    `corrected`: the ground takes corrections, of which those follow that the `link` has made.
    `drop` are those, in their order, that are lost besides the first time.
    """
    made = Recovered()
    counters = made.counters
    reorderer = rtp.Reorderer(counters)
    depacketizer, retransmission = rtp.Depacketizer(counters), reorderer.retransmission
    retransmission.offered = offered
    retransmission.round_trip.hint(round_trip_ms * MS, 0)
    corrections, arrivals, correction = (
        Sender(link, ssrc, sends_again=offered),
        Arrivals(),
        Correction(),
    )
    correction.offered = corrected
    ahead, back = Loss(does, seed), Loss(does, seed + 1)
    number, sends = itertools.count(), itertools.count()
    events: list[tuple[int, int, str, bytes]] = []  # when, in what order, what happens
    history: dict[int, tuple[int, bytes]] = {}
    half_ms, last_ms = round_trip_ms // 2, 1000 * len(frames) // RATE_HZ

    def later(at_ms: int, what: str, datagram: bytes) -> None:
        heapq.heappush(events, (at_ms, next(number), what, datagram))

    def happened(now_ms: int) -> Iterator[tuple[rtp.Packet, bool]]:
        while events and events[0][0] <= now_ms:
            _, _, what, datagram = heapq.heappop(events)
            if what == "send":
                if datagram[1] & 0x7F == 96:
                    history[int.from_bytes(datagram[2:4], "big")] = (now_ms, datagram)
                sent = next(sends)
                if ahead.takes() or sent in drop:
                    made.lost += 1
                else:
                    later(now_ms + half_ms, "came", datagram)
            elif what == "asked":
                for sequence in rtcp.asked_for(datagram, ssrc):
                    at_ms, kept = history.get(sequence, (-history_ms, b""))
                    if now_ms - at_ms < history_ms and not ahead.takes():
                        later(now_ms + half_ms, "came", sent_again(kept))
            else:
                packet = rtp.parse(datagram, now_ms * MS)
                assert packet is not None
                arrivals.add(packet)
                made.again += packet.again
                if packet.corrects:
                    counters.corrections += 1
                    reorderer.corrected_ns = packet.arrival_ns
                else:
                    counters.packets += not packet.again
                    yield from reorderer.push(packet)
                for found in correction.take(packet):
                    yield from reorderer.push(found)

    def send(index: int, datagrams: Sequence[bytes]) -> None:
        made.sent_bytes += sum(map(len, datagrams))
        behind = [*corrections.of(datagrams)] if datagrams and corrections.wanted else []
        made.correction_bytes += sum(map(len, behind))
        for place, datagram in enumerate([*datagrams, *behind]):
            later(1000 * index // RATE_HZ + place // 4, "send", datagram)

    def report(now_ms: int) -> None:
        flow = arrivals.flow(now_ms * MS)
        corrections.forecast.report(
            LinkReport(
                now_ms * MS, "main", 5600, ssrc, corrects=corrected,
                packets_lost=counters.packets_lost, answered=counters.retransmissions,
                dropped=flow.dropped if flow else None, burst=flow.burst if flow else None,
            ),
            now_ms / 1000,
        )  # fmt: skip

    starts = {1000 * index // RATE_HZ: index for index in range(len(frames))}
    for now_ms in range(last_ms + 1000):
        if now_ms in starts:
            send(starts[now_ms], frames[starts[now_ms]])
        if now_ms % 1000 == 999:
            report(now_ms)
        ready = list(happened(now_ms))
        if asked := retransmission.due(now_ms * MS):
            made.nacks += 1
            if not back.takes():
                later(now_ms + half_ms, "asked", rtcp.nack(1, ssrc, asked))
        for ordered, gap in [*ready, *reorderer.expire(now_ms * MS)]:
            made.units += [(now_ms, unit) for unit in depacketizer.push(ordered, gap)]
    return made


def sent_again(datagram: bytes, ssrc: int = 99, number: int = 0) -> bytes:
    """The retransmission of an RTP packet (RFC 4588, 4)."""
    head = bytes([datagram[0], datagram[1] & 0x80 | 97]) + number.to_bytes(2, "big")
    return head + datagram[4:8] + ssrc.to_bytes(4, "big") + datagram[2:4] + datagram[12:]


def shown(made: Recovered, idr: Sequence[int]) -> list[int]:
    """Of frames numbered by the order of their units: those that a decoder may show.

    `idr` says which frames are IDRs; after a loss nothing is shown up to the next one.
    """
    return [*_shown(made, frozenset(idr))]


def _shown(made: Recovered, idr: frozenset[int]) -> Iterator[int]:
    trusted = False
    for _, unit in made.units:
        if unit.missing_before or not unit.complete:
            trusted = False
        if not unit.complete:
            continue
        index = int.from_bytes(unit.data[-4:], "big")
        trusted = trusted or index in idr
        if trusted:
            yield index
