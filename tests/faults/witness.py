"""Follows a stream where it enters a link: what left the payload, and what can be seen of it.

It reads the packets themselves and believes no counter of either side, so that both can be held
against it.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from ground_station.stream.srtp import Unprotector
from pi_firmware.wire import annexb, sei

_BESIDE = {annexb.NAL_SEI, annexb.NAL_SPS, annexb.NAL_PPS}
_FU_A, _FU_END = 28, 0x40
_CLOSING_BYTES = 3
"""Of a slice's last fragment with its two bytes of header, one more: with what closes arithmetic
coding (H.264, 9.3.4.5) and the trailing bits it may say nothing of the picture. Two in 4,464 frames
ended so; decoded without it they and those after them were the same, bit for bit."""


@dataclass(frozen=True)
class Left:
    """One frame that left the payload; `damaged` when the link lost any part of it, `cut` when that
    was one of its picture and not of what stands beside it.

    An access unit delimiter before parameter sets is no part: these only ever come first, too.
    """

    sequence: int
    idr: bool
    damaged: bool
    cut: bool


class _Stream:
    def __init__(self) -> None:
        self.depacketizer = rtp.Depacketizer(Counters())
        self.next_sequence: int | None = None
        self.damaged = self.undelimited = self.cut = False
        self.frames: list[Left] = []


class Witness:
    """The tap of an `ImpairedLink`; streams are told apart by SSRC.

    With `keys`, SRTP keys by payload, it hears what is sent with them, and that only.
    """

    def __init__(self, keys: Mapping[str, bytes] | None = None) -> None:
        self._unprotector = None if keys is None else Unprotector(keys)
        self.gaps = 0
        """Packets that were missing before the link: the sender's or this machine's doing."""
        self.strangers = 0
        """Datagrams that are no video of ours, or frames without their numbers."""
        self._streams: dict[int, _Stream] = {}
        self._lock = threading.Lock()

    def __call__(self, datagram: bytes, lost: bool) -> None:
        if self._unprotector is not None:
            datagram = self._unprotector.unprotect(datagram) or b""
        packet = rtp.parse(datagram, 0)
        with self._lock:
            if packet is None:
                self.strangers += 1
            else:
                self._follow(packet, lost)

    def ssrcs(self) -> list[int]:
        """The streams seen, in order of their first packets."""
        with self._lock:
            return list(self._streams)

    def left(self, ssrc: int | None = None) -> list[Left]:
        """The frames of a stream (of all without an SSRC) that have left the payload whole."""
        with self._lock:
            streams = self._streams.values() if ssrc is None else [self._streams[ssrc]]
            return [frame for stream in streams for frame in stream.frames]

    def visible(self, ssrc: int | None = None) -> list[int]:
        """Sequence numbers of the frames that a receiver surely shows whole: undamaged, as are all
        since the last IDR, an undamaged one itself."""
        return list(_since_idr((frame, frame.damaged) for frame in self.left(ssrc)))

    def showable(self, ssrc: int | None = None) -> list[int]:
        """Those that it may show whole: no picture was cut since the last IDR, it included.

        It can do without the SEI where the clocks tell the frame, and without parameter sets that
        it has.
        """
        return list(_since_idr((frame, frame.cut) for frame in self.left(ssrc)))

    def _follow(self, packet: rtp.Packet, lost: bool) -> None:
        stream = self._streams.setdefault(packet.ssrc, _Stream())
        if stream.next_sequence is not None:
            ahead = (packet.sequence - stream.next_sequence) & 0xFFFF
            self.gaps += ahead - (ahead >> 15 << 16)  # out of order they cancel each other
        stream.next_sequence = (packet.sequence + 1) & 0xFFFF
        if packet.payload[0] & 0x1F == annexb.NAL_AUD:
            stream.undelimited = lost
        else:
            stream.damaged |= lost
            stream.cut |= lost and _is_of_a_picture(packet.payload)
        for unit in stream.depacketizer.push(packet, False):
            info = sei.find(unit.data)
            if info is None:
                self.strangers += 1
            else:
                idr = annexb.is_idr(unit.data)
                damaged = stream.damaged or (stream.undelimited and not idr)
                stream.frames.append(Left(info.sequence, idr, damaged, stream.cut))
            stream.damaged = stream.undelimited = stream.cut = False


def _is_of_a_picture(payload: bytes) -> bool:
    """Whether a picture surely lacks something without this packet."""
    kind = payload[0] & 0x1F
    closes = len(payload) == _CLOSING_BYTES and kind == _FU_A and payload[1] & _FU_END
    return kind not in _BESIDE and not closes


def _since_idr(frames: Iterable[tuple[Left, bool]]) -> Iterator[int]:
    """The frames that have nothing wrong, nor has any other since the last IDR."""
    trusted = False
    for frame, wrong in frames:
        trusted = not wrong and (frame.idr or trusted)
        if trusted:
            yield frame.sequence
