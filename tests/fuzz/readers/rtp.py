"""`ground_station.stream.rtp`: a stranger's packets, reordered and put together."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from pieces import Picker, blocks, stretch

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from pi_firmware.wire import video

_STEP_NS = 5_000_000


def datagrams(data: bytes) -> Iterator[bytes]:
    """RTP packets: two bits of the head are the input's, numbers go on from those before."""
    picker, sequence, timestamp = Picker(data), 0, 0
    while picker.left():
        how = picker.number(1)
        first, second = 0x80, video.PAYLOAD_TYPE
        if how & 1:
            second |= 0x80  # the marker
        if how & 2:
            sequence = (sequence + picker.number(2)) & 0xFFFF
        if how & 4:
            timestamp = (timestamp + 3000) & 0xFFFFFFFF
        if how & 8:
            first |= picker.number(1)  # CSRCs, extension, padding
        ssrc = 7 if how & 16 == 0 else picker.number(4)
        head = struct.pack(">BBHII", first, second, sequence, timestamp, ssrc)
        yield picker.block() if how & 32 else head + picker.block()
        sequence = (sequence + 1) & 0xFFFF


def fuzz(data: bytes) -> None:
    """Every packet is accounted for, and no access unit is larger than allowed."""
    counters, taken, given = Counters(), 0, 0
    reorderer, depacketizer = rtp.Reorderer(counters), rtp.Depacketizer(counters)
    now_ns = 0
    for datagram in datagrams(data):
        now_ns += _STEP_NS
        packet = rtp.parse(datagram, now_ns)
        if packet is None:
            continue
        taken += 1
        assert packet.payload
        ready = [*reorderer.push(packet), *reorderer.expire(now_ns)]
        given += len(ready)
        for ordered, gap in ready:
            for unit in depacketizer.push(ordered, gap):
                assert len(unit.data) <= rtp.MAX_ACCESS_UNIT_BYTES + 3 * 0x10000
    given += sum(1 for _ in reorderer.expire(now_ns + 10**12))
    assert given <= taken


def packet(how: int, payload: bytes) -> bytes:
    """One in the form of `datagrams`, for a `how` that asks for no more bytes."""
    return bytes([how]) + blocks(payload)


def seeds() -> list[bytes]:
    """Single units, an aggregate, fragments, a loss, a new start, a flood of small ones."""
    return [
        packet(0, b"\x67abc") + packet(0, b"\x68abc") + packet(1, b"\x65" + b"x" * 50),
        packet(5, b"\x18\0\3\x67ab\0\3\x68ab"),
        packet(4, b"\x7c\x85aaa") + packet(0, b"\x7c\5bbb") + packet(1, b"\x7c\x45ccc"),
        packet(5, b"\x65aa") + b"\2\3\0" + blocks(b"\x61bb") + packet(5, b"\x61cc"),
        packet(1, b"\x65a") + b"\2\0\x40" + blocks(b"\x65b") + packet(1, b"\x61c"),
        b"\x08\x10" + blocks(b"\xbe\xde\0\1abcd\x65aa") + b"\x08\x20" + blocks(b"\x65ab\2"),
        b"\x20" + blocks(b"\x80\x60"),
        stretch((20_000, packet(0, b"\x61"))),
        stretch((20_000, packet(0, b"\x7c\x85")), (20_000, packet(0, b"\x18\0\1a"))),
        stretch((9_000, b"\2\2\0" + blocks(b"\x61"))),
    ]
