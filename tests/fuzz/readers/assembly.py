"""`ground_station.stream.assembly`: packets to decoded pictures, none painted over a loss."""

from __future__ import annotations

from pieces import blocks

from ground_station.stream import rtp
from ground_station.stream.assembly import Assembly
from ground_station.stream.counters import Counters
from pi_firmware.wire import annexb
from readers import h264
from readers.rtp import datagrams, packet

_STEP_NS = 5_000_000
_MOST_PACKETS = 200


def fuzz(data: bytes) -> None:
    """All frames have a size that is allowed."""
    counters = Counters()
    made = Assembly(7, counters)
    now_ns = 0
    for number, datagram in enumerate(datagrams(data)):
        now_ns += _STEP_NS
        if number >= _MOST_PACKETS:
            break
        if (taken := rtp.parse(datagram, now_ns)) is not None:
            for frame in [*made.push(taken), *made.expire(now_ns)]:
                assert frame.image.size <= 1920 * 1088 and frame.image.ndim == 2
    list(made.expire(now_ns + 10**12))


def seeds() -> list[bytes]:
    """A stream of two frames; with its second unit damaged; with one packet missing."""
    whole = []
    for data in h264.access_units():
        units = list(annexb.nal_units(data))
        whole += [packet(4 if n == 0 else 0, unit) for n, unit in enumerate(units[:-1])]
        whole.append(packet(1, units[-1]))
    sps = b"\x67\x64\0\x33\xac\xb4\2\0\2\0"
    large = packet(4, sps) + packet(0, b"\x68\xee\x3c\x80") + packet(1, b"\x65\x88\x84\0")
    hole = b"\2\1\0" + blocks(b"\x61")
    return [b"".join(whole), b"".join(whole[:-1]) + hole + b"".join(whole), large]
