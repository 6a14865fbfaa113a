"""`ground_station.stream.retransmission`: packets, again and for the first time, and a clock."""

from __future__ import annotations

import struct

from pieces import Picker, blocks, stretch

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from ground_station.stream.retransmission import LIVE_NS
from pi_firmware.wire import rtcp, video

_MS = 1_000_000
_MOST_PACKETS = 600


def fuzz(data: bytes) -> None:
    """Each packet is counted once, nothing is asked for twice at once, and nobody waits longer."""
    picker, counters = Picker(data), Counters()
    reorderer = rtp.Reorderer(counters)
    retransmission = reorderer.retransmission
    retransmission.offered = True
    sequence = taken = given = now_ns = 0
    held_since: dict[int, int] = {}
    while picker.left() and taken < _MOST_PACKETS:
        how = picker.number(1)
        now_ns += _MS * (picker.number(1) if how & 1 else 1)
        if how & 2:
            sequence = (sequence + picker.number(2)) & 0xFFFF
        if how & 4:
            retransmission.round_trip.hint(picker.number(4) * 1000, now_ns)
        kind, number, osn = video.PAYLOAD_TYPE, sequence, b""
        if how & 8:
            kind, osn = video.RTX_PAYLOAD_TYPE, picker.bytes(2)
        head = struct.pack(">BBHII", 0x80, kind, number, 0, 7)
        packet = rtp.parse(head + osn + picker.block(), now_ns)
        if packet is None:
            continue
        taken += 1
        ready = [*reorderer.push(packet)]
        asked = retransmission.due(now_ns)
        assert len(set(asked)) == len(asked)
        assert set(rtcp.asked_for(rtcp.nack(1, 7, asked), 7)) == set(asked)
        ready += reorderer.expire(now_ns)
        given += len(ready)
        for ordered, _ in ready:
            held_since.pop(ordered.sequence, None)
        held_since = {
            held.sequence: held_since.get(held.sequence, now_ns)
            for held in reorderer._held.values()
        }
        # Whatever comes: several gaps, one behind another, each missed later than the one before.
        assert all(now_ns - since <= 2 * LIVE_NS + 255 * _MS for since in held_since.values())
        assert len(retransmission._missing) <= 256 and len(retransmission._ambiguous) <= 256
        assert len(rtcp.nack(1, 7, asked)) <= 1100
        sequence = (sequence + (not how & 8)) & 0xFFFF
    assert given <= taken and counters.packets_recovered <= counters.packets_asked
    assert counters.packets_recovered <= counters.retransmissions
    for _ in range(3):
        now_ns += LIVE_NS + _MS
        retransmission.due(now_ns)
        given += sum(1 for _ in reorderer.expire(now_ns))
    assert not reorderer._held and retransmission.next_ns() is None


def sent(how: int, *more: bytes) -> bytes:
    """One packet of the form above."""
    return bytes([how]) + b"".join(more) + blocks(b"\x61ab")


def seeds() -> list[bytes]:
    """In order; with a hole that is recovered; one that is not; again unasked; far off; floods."""
    one, hole = sent(0), sent(2, b"\2\0")
    return [
        one * 5,
        one + hole + sent(8, b"\0\1") + sent(8, b"\0\2") + one,
        one + hole + sent(1, b"\xff") + one + sent(8, b"\0\1"),
        sent(8, b"\0\0") + one + sent(8, b"\0\0") + sent(8, b"\xff\xff"),
        one + sent(4, b"\0\0\1\0") + hole + sent(2, b"\0\x40") + one + one,
        stretch((600, hole)),
        stretch((200, hole), (200, sent(8, b"\0\5"))),
        stretch((10, one), (200, sent(2, b"\xfe\xff") + sent(2, b"\3\0"))),
    ]
