"""RTCP feedback on the video: which packets the receiver asks for again (RFC 4585).

Packets are of reduced size, without a report before the feedback (RFC 5506): both sides have
announced in telemetry that they take them. A reader takes compound ones as well.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

HEADER_BYTES = 8
"""The first header with its sender's SSRC: what SRTCP leaves readable (RFC 3711, 3.4)."""

_RTPFB, _GENERIC_NACK = 205, 1  # RFC 4585, 6.2.1
_LOWEST_TYPE, _HIGHEST_TYPE = 192, 223  # RFC 5761, 4: what is told from RTP by its second byte
_BLP_BITS = 16
MOST_ASKED = 1024
"""Numbers taken from one datagram, at most: what a sender may be made to look up."""


def nack(sender_ssrc: int, media_ssrc: int, sequences: Iterable[int]) -> bytes:
    """A generic NACK for these RTP sequence numbers (16 bits), each a packet that is missing."""
    entries: list[tuple[int, int]] = []
    for sequence in sequences:
        if entries:
            first, mask = entries[-1]
            behind = (sequence - first) & 0xFFFF
            if behind <= _BLP_BITS:
                entries[-1] = (first, mask | 1 << behind >> 1)
                continue
        entries.append((sequence, 0))
    head = struct.pack(
        ">BBHII", 0x80 | _GENERIC_NACK, _RTPFB, 2 + len(entries), sender_ssrc, media_ssrc
    )
    return head + b"".join(struct.pack(">HH", first, mask) for first, mask in entries)


def sender_of(datagram: bytes) -> int | None:
    """The SSRC of who sent RTCP or SRTCP; None for what is neither."""
    if len(datagram) < HEADER_BYTES or datagram[0] >> 6 != 2:
        return None
    if not _LOWEST_TYPE <= datagram[1] <= _HIGHEST_TYPE:
        return None
    return int.from_bytes(datagram[4:8], "big")


def asked_for(datagram: bytes, media_ssrc: int) -> list[int]:
    """The sequence numbers of a stream's packets that RTCP asks for; none in what is malformed."""
    asked: list[int] = []
    at = 0
    while at + HEADER_BYTES <= len(datagram):
        first, kind, words = struct.unpack_from(">BBH", datagram, at)
        end = at + 4 * (words + 1)
        if first >> 6 != 2 or end > len(datagram):
            break
        if kind == _RTPFB and first & 0x1F == _GENERIC_NACK and words >= 2:
            (media,) = struct.unpack_from(">I", datagram, at + 8)
            if media == media_ssrc:
                for sequence, mask in struct.iter_unpack(">HH", datagram[at + 12 : end]):
                    asked.append(sequence)
                    while mask:
                        low = mask & -mask
                        asked.append((sequence + low.bit_length()) & 0xFFFF)
                        mask ^= low
                    if len(asked) >= MOST_ASKED:
                        return asked[:MOST_ASKED]
        at = end
    return asked
