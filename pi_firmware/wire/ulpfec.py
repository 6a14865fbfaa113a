"""Forward correction of the video: packets that are the exclusive-or of others (RFC 5109).

A packet counts here as one integer, little-endian: the recovery fields of its RTP header and its
length (8 bytes), then its payload, which a longer one's outlasts by zeros. Its sequence number is
in none of it: the mask tells that.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from pi_firmware.wire import video

MOST_PROTECTED = 48
"""Bits of the long mask: packets from the first to the last that one correction covers."""
OVERHEAD_BYTES = 18
"""What a correction is larger than the largest packet that it covers, at most."""

_FIELDS, _HEADER = struct.Struct(">BBIH"), struct.Struct(">BBHIHH")
_EXTENDED, _LONG = 0x80, 0x40


def bits(second: int, timestamp: int, payload: bytes) -> int:
    """A packet without CSRCs, extension and padding, of its RTP header's second byte."""
    return int.from_bytes(_FIELDS.pack(0, second, timestamp, len(payload)) + payload, "little")


@dataclass(frozen=True)
class Correction:
    """The exclusive-or `value` of the packets with these RTP sequence numbers.

    The largest one's payload has `size` bytes.
    """

    sequences: Sequence[int]
    value: int
    size: int

    def encode(self) -> bytes:
        """The payload of its RTP packet; the numbers rise from the first, by 47 at most."""
        base = self.sequences[0]
        ahead = [(sequence - base) & 0xFFFF for sequence in self.sequences]
        width = 16 if ahead[-1] < 16 else MOST_PROTECTED
        mask = sum(1 << width - 1 - each for each in ahead)
        plain = self.value.to_bytes(_FIELDS.size + self.size, "little")
        first, second, timestamp, length = _FIELDS.unpack_from(plain)
        first |= _LONG if width > 16 else 0
        head = _HEADER.pack(first, second, base, timestamp, length, self.size)
        return head + mask.to_bytes(width // 8, "big") + plain[_FIELDS.size :]

    @classmethod
    def decode(cls, payload: bytes) -> Correction | None:
        """Of an RTP packet's payload; None unless it has one level that covers all of something."""
        if len(payload) < _HEADER.size + 2:
            return None
        first, second, base, timestamp, length, size = _HEADER.unpack_from(payload)
        width = MOST_PROTECTED if first & _LONG else 16
        start = _HEADER.size + width // 8
        mask = int.from_bytes(payload[_HEADER.size : start], "big")
        if first & _EXTENDED or not mask or len(payload) != start + size:
            return None
        ahead = [each for each in range(width) if mask >> width - 1 - each & 1]
        plain = _FIELDS.pack(first & 0x3F, second, timestamp, length) + payload[start:]
        sequences = [(base + each) & 0xFFFF for each in ahead]
        return cls(sequences, int.from_bytes(plain, "little"), size)


def packet(value: int, sequence: int, ssrc: int) -> bytes | None:
    """The RTP packet that is left of a correction; None when that cannot be one of the video's."""
    plain = value.to_bytes(max(_FIELDS.size, (value.bit_length() + 7) // 8), "little")
    first, second, timestamp, length = _FIELDS.unpack_from(plain)
    payload = plain[_FIELDS.size :]
    if first or second & 0x7F != video.PAYLOAD_TYPE or len(payload) > length:
        return None
    head = struct.pack(">BBHII", 0x80, second, sequence, timestamp, ssrc)
    return head + payload.ljust(length, b"\0")
