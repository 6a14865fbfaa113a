"""`ground_station.stream.correction`: packets and corrections of frames, genuine and forged."""

from __future__ import annotations

import struct

from pieces import Picker, blocks, stretch

from ground_station.stream import correction as corrections
from ground_station.stream import rtp
from ground_station.stream.correction import Correction
from pi_firmware.correction import protect
from pi_firmware.wire import ulpfec, video

_MOST_FRAMES = 60


def fuzz(data: bytes) -> None:
    """What is found without forged ones is what was sent, and no more than allowed is kept."""
    picker, correction = Picker(data), Correction()
    correction.offered = True
    first = timestamp = 0
    sent: dict[tuple[int, int], bytes] = {}
    forged = False
    for _ in range(_MOST_FRAMES):
        if not picker.left():
            break
        how = picker.number(1)
        first, timestamp = (first + picker.number(1)) & 0xFFFF, timestamp + (how & 1)
        if how & 2:  # a correction of any form
            payload, forged = picker.block(), True
            decoded = ulpfec.Correction.decode(payload)
            if decoded is not None:
                assert ulpfec.Correction.decode(decoded.encode()) == decoded
            datagrams = [_head(video.CORRECTION_PAYLOAD_TYPE, 0, timestamp) + payload]
        else:
            count = 1 + picker.number(1) % ulpfec.MOST_PROTECTED
            seed, longest = picker.number(1), 1 + picker.number(1)
            frame = [
                _head(96 | (number == count - 1) << 7, first + number, timestamp)
                + bytes([seed ^ number, *range(1 + number * seed % longest)])
                for number in range(count)
            ]
            payloads = protect(frame, picker.number(1) % 17)
            head = _head(video.CORRECTION_PAYLOAD_TYPE, 1, timestamp)
            datagrams = frame + [head + payload for payload in payloads]
            forged |= any((timestamp, first + n & 0xFFFF) in sent for n in range(count))
            sent |= {(timestamp, first + n & 0xFFFF): each for n, each in enumerate(frame)}
            first = (first + count) & 0xFFFF
            lost = picker.number(4)
            datagrams = [each for n, each in enumerate(datagrams) if not lost >> n % 32 & 1]
            if how & 4:
                datagrams.reverse()
        for datagram in datagrams:
            packet = rtp.parse(datagram, 0)
            for found in correction.take(packet) if packet is not None else ():
                original = rtp.parse(sent.get((found.timestamp, found.sequence), b""), 0)
                assert found.corrected and (
                    forged or (original and found.payload == original.payload)
                )
            equations = correction._equations
            assert len(correction._came) <= corrections._KEPT_PACKETS
            assert len(equations) <= corrections._KEPT_EQUATIONS
            assert all(1 < len(each.missing) <= 96 for each in equations.values())
            assert not any(key in correction._came for key in equations)


def _head(second: int, sequence: int, timestamp: int) -> bytes:
    return struct.pack(">BBHII", 0x80, second, sequence & 0xFFFF, timestamp & 0xFFFFFFFF, 7)


def made(how: int, count: int, given: int, lost: int) -> bytes:
    """One frame of the form above."""
    return bytes([how, 0, count - 1, 9, 80, given]) + lost.to_bytes(4, "little")


def seeds() -> list[bytes]:
    """Frames with and without losses, reversed, large; forged corrections; floods of them."""
    (parity,) = protect([_head(96, number, 1) + b"\x61ab" for number in range(3)], 1)
    wide = ulpfec.Correction(range(0, 48, 3), 1 << 70, 9).encode()
    forged = [b"\3\0" + blocks(each) for each in (parity, parity[:-1], wide, b"\x80" + wide[1:])]
    return [
        made(1, 6, 3, 0) + made(1, 6, 3, 0b11) + made(5, 6, 3, 0b100101),
        made(1, 48, 16, 0x8421) + made(1, 1, 1, 1) + made(0, 6, 3, 0b11),
        b"".join(forged) + made(0, 6, 2, 1),
        stretch((200, made(1, 20, 2, 0b1111_0000))),
        stretch((250, b"\2\1" + blocks(wide))),
    ]
