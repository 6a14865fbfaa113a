"""`pi_firmware.wire.rtcp` and `srtcp`: what is asked of the payload, authentic and forged."""

from __future__ import annotations

import hmac
import struct

from pieces import Picker, blocks, stretch

from pi_firmware.wire import rtcp
from pi_firmware.wire.srtcp import SrtcpProtector, SrtcpUnprotector, derive

_MASTER = bytes(range(30))
_MOST_PACKETS = 500
_TAG_KEY = derive(_MASTER, 4, 20)


def fuzz(data: bytes) -> None:
    """Nothing but what was authentic and new is read, and no more is asked for than allowed."""
    picker = Picker(data)
    unprotector, protector = SrtcpUnprotector(_MASTER), SrtcpProtector("blimp-1", _MASTER)
    seen: set[bytes] = set()
    for _ in range(_MOST_PACKETS):
        if not picker.left():
            break
        how = picker.number(1)
        plain = picker.block()
        if how & 1:
            plain = struct.pack(">BBHII", 0x81, 205, len(plain) // 4 + 2, 1 + (how >> 6), 7) + plain
        asked = rtcp.asked_for(plain, 7)
        assert len(asked) <= rtcp.MOST_ASKED and all(0 <= number < 0x10000 for number in asked)
        assert rtcp.asked_for(plain, 8) == [] or not how & 1
        if rtcp.sender_of(plain) is None:
            continue
        if how & 2:
            datagram = protector.protect(plain)
        elif how & 4:  # authentic, and of any index
            said = plain + picker.bytes(4)
            datagram = said + hmac.digest(_TAG_KEY, said, "sha1")[:10]
        else:
            datagram = plain + picker.bytes(14)
        opened = unprotector.unprotect(datagram)
        assert opened is None or how & 6
        assert opened is None or len(opened) == len(datagram) - 14
        # What is so old that its sender is forgotten is read again; of these there are few senders.
        assert opened is None or datagram not in seen or len(unprotector._senders) == 8
        if opened is not None:
            seen.add(datagram)
            rtcp.asked_for(opened, 7)
        assert len(unprotector._senders) <= 8


def seeds() -> list[bytes]:
    """A NACK, protected, forged, cut, compound, with lengths that cannot be, and many."""
    entry = struct.pack(">HH", 65_530, 0xFFFF)
    report = struct.pack(">BBHI", 0x80, 201, 1, 5)
    nack = rtcp.nack(1, 7, [1, 2, 600])
    return [
        b"\1" + blocks(entry),
        b"\3" + blocks(entry) + b"\3" + blocks(entry * 3),
        b"\0" + blocks(nack[:-2]) + b"\0" + blocks(report + nack),
        b"\5" + blocks(entry) + b"\x80\0\0\1" + b"\5" + blocks(entry) + b"\x80\0\0\1",
        b"\1" + blocks(entry) + bytes(14),
        b"\0"
        + blocks(b"\x81\xcd\xff\xff" + bytes(12))
        + b"\0"
        + blocks(b"\x81\xcd\0\0" + bytes(9)),
        stretch((500, b"\3" + blocks(entry))),
    ]
