"""`ground_station.stream.srtp`: packets that are authentic, or pretend to be."""

from __future__ import annotations

import hmac
import struct

from pieces import Picker, blocks, stretch

from ground_station.stream.srtp import STREAMS, Unprotector
from pi_firmware.wire import video
from pi_firmware.wire.srtcp import derive

_MASTER = bytes(range(30))
_MOST_PACKETS = 2000
_TAGS = 4
"""Packets of an input that may make it search, which takes long on purpose."""


def fuzz(data: bytes) -> None:
    """What is given out was authentic."""
    picker, now_s = Picker(data), 0.0
    unprotector = Unprotector({"blimp-1": _MASTER}, clock=lambda: now_s)
    key = derive(_MASTER, 1, 20)
    sequence = forged = taken = 0
    while picker.left() and taken < _MOST_PACKETS:
        taken += 1
        how = picker.number(1)
        if how & 1:
            sequence = (sequence + picker.number(2)) & 0xFFFF
        ssrc = picker.number(4) if how & 2 else 7
        first = 0x80 | (picker.number(1) if how & 4 else 0)
        head = struct.pack(">BBHII", first, video.PAYLOAD_TYPE, sequence, 0, ssrc)
        datagram = picker.block() if how & 8 else head + picker.block()
        if how & 16 and forged < _TAGS:
            forged += 1
            datagram += picker.bytes(10)
        else:
            roc = picker.number(1).to_bytes(4, "big")
            datagram += hmac.digest(key, datagram + roc, "sha1")[:10]
        out = unprotector.unprotect(datagram)
        assert out is None or len(out) == len(datagram) - 10
        assert len(unprotector._streams) <= STREAMS
        sequence = (sequence + 1) & 0xFFFF
        now_s += 0.001


def seeds() -> list[bytes]:
    """In order, again, out of order, with an extension, another stream, forged."""
    one = b"\0" + blocks(b"\x65abc") + b"\0"
    return [
        one * 3,
        one + b"\1\xff\xff" + blocks(b"\x65abc") + b"\0",
        b"\4\x10" + blocks(b"\xbe\xde\0\1abcd\x65") + b"\0",
        b"\2\1\2\3\4" + blocks(b"\x65") + b"\1" + one,
        b"\x10" + blocks(b"\x65abc") + b"0123456789",
        b"\x08" + blocks(b"\x80\x60"),
        stretch((2000, one)),
    ]
