"""RTP packets back into H.264 access units (RFC 3550, RFC 6184), with every gap noticed."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from ground_station.stream.counters import Counters
from ground_station.stream.retransmission import LIVE_NS, Retransmission
from pi_firmware.wire import video
from pi_firmware.wire.annexb import NAL_AUD, NAL_IDR, NAL_SLICE, NAL_SPS, START_CODE

HEADER_BYTES = 12
CLOCK_HZ = 90_000
"""Of timestamps of H.264 (RFC 6184, section 8.2.1)."""
_STAP_A, _FU_A = 24, 28
_FU_START, _FU_END = 0x80, 0x40
MAX_JUMP = 3000
"""A sequence number further ahead than this is a new stream, not a loss (RFC 3550, A.1)."""
MAX_ACCESS_UNIT_BYTES = 4 << 20
_DEPTH = 32
"""Later packets for which a missing one is waited for."""
_LONGEST_WAIT_NS = 30_000_000
_LEAST_WAIT_NS = 5_000_000
"""What is missing is waited for so long at least: the packets of one frame come within less."""
_CORRECTED_NS = 1_000_000_000
"""After so long without a correction none is waited for."""


@dataclass(frozen=True)
class Packet:
    """One RTP packet of H.264; `arrival_ns` is on the receiver's monotonic clock.

    It is when it was read; before that it lay in the machine for `waited_ns`. `again`: a
    retransmission (RFC 4588), of whose packet `sequence` and `payload` are the original's.
    `corrects`: no packet of H.264, but what corrects others (RFC 5109). `corrected`: found from
    such. `plain`: without CSRCs, extension and padding.
    """

    sequence: int
    timestamp: int
    ssrc: int
    marker: bool
    payload: bytes
    arrival_ns: int
    waited_ns: int = 0
    again: bool = False
    corrects: bool = False
    corrected: bool = False
    plain: bool = True

    @property
    def came_ns(self) -> int:
        """When it came to the machine, however late its reader was."""
        return self.arrival_ns - self.waited_ns


def header_bytes(packet: bytes) -> int | None:
    """What an RTP packet's header takes, with CSRCs and extension.

    None when it is not whole, not of version 2, or of no payload type of the video's.
    """
    if len(packet) < HEADER_BYTES or packet[0] >> 6 != 2:
        return None
    if packet[1] & 0x7F not in video.PAYLOAD_TYPES:
        return None
    size = HEADER_BYTES + 4 * (packet[0] & 0x0F)
    if packet[0] & 0x10:  # header extension
        if len(packet) < size + 4:
            return None
        size += 4 + 4 * int(struct.unpack_from(">H", packet, size + 2)[0])
    return size if size <= len(packet) else None


def parse(datagram: bytes, arrival_ns: int, waited_ns: int = 0) -> Packet | None:
    """The packet in a datagram; None when it is not RTP version 2 with a payload type of the video.

    Of a retransmission and a correction `ssrc` is their own stream's, and not the original's.
    """
    start = header_bytes(datagram)
    if start is None:
        return None
    first, second, sequence, timestamp, ssrc = struct.unpack_from(">BBHII", datagram)
    kind = second & 0x7F
    again, corrects = kind == video.RTX_PAYLOAD_TYPE, kind == video.CORRECTION_PAYLOAD_TYPE
    end = len(datagram)
    if first & 0x20:  # padding; its last byte counts it
        end -= datagram[-1]
    if again:
        if start + video.OSN_BYTES >= end:
            return None
        (sequence,) = struct.unpack_from(">H", datagram, start)
        start += video.OSN_BYTES
    if start >= end:
        return None
    payload, marker = datagram[start:end], bool(second & 0x80)
    return Packet(
        sequence, timestamp, ssrc, marker, payload, arrival_ns, waited_ns, again, corrects,
        plain=not first & 0x3F,
    )  # fmt: skip


class Reorderer:
    """Puts packets of one stream in order and decides when a missing one is lost.

    While `retransmission` helps, that is when it cannot come any more. Otherwise it is waited for
    until 32 later ones are here, or 30 ms have passed, and less where those that are missing turn
    out to be lost and not overtaken; while corrections come, which follow their frame, only those
    of later frames count.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._wait_ns = _LONGEST_WAIT_NS
        self.retransmission = Retransmission(counters)
        """What is missing, and when that is to be asked for."""
        self._expected: int | None = None
        self._held: dict[int, Packet] = {}
        self._next = 0
        """After the newest packet."""
        self._came_ns = 0
        self.corrected_ns: int | None = None
        """When the newest correction came."""
        self._jumped: Packet | None = None

    @property
    def holds(self) -> bool:
        """Whether packets wait for what is missing before them."""
        return bool(self._held)

    def push(self, packet: Packet) -> Iterator[tuple[Packet, int]]:
        """Packets that can go on, each with how many before it are missing."""
        if packet.again:
            self._counters.retransmissions += 1
            if not self.retransmission.came(packet.sequence, packet.arrival_ns, again=True):
                return  # nobody waits for it
            self._counters.packets_recovered += 1
            self._held[packet.sequence] = packet
            yield from self._release(patient=True)
            return
        if self._expected is None:
            self._begin(packet.sequence)
        assert self._expected is not None
        ahead = (packet.sequence - self._expected) & 0xFFFF
        if MAX_JUMP < ahead < 0x10000 - MAX_JUMP:
            if not packet.corrected:
                yield from self._restart(packet)
        elif ahead > MAX_JUMP or packet.sequence in self._held:
            self._counters.packets_late += not packet.corrected  # given up on, or here already
            if packet.sequence not in self._held:
                self._wait_ns = _LONGEST_WAIT_NS
        else:
            self._counters.packets_corrected += packet.corrected
            self._note(packet)
            self._held[packet.sequence] = packet
            patient = self.retransmission.helps or len(self._held) <= _DEPTH
            if not patient:
                patient = len(self._later(packet.arrival_ns)) <= _DEPTH
            yield from self._release(patient=patient)

    def expire(self, now_ns: int) -> Iterator[tuple[Packet, int]]:
        """Packets that go on because what is missing before them has not come in time."""
        if self._held:
            later = (packet.arrival_ns for packet in self._later(now_ns))
            patient = (
                self.retransmission.helps or now_ns - min(later, default=now_ns) < self._wait_ns
            )
            yield from self._release(patient=patient)

    def _later(self, now_ns: int) -> list[Packet]:
        """Held packets behind which nothing that is missing is on its way, but for overtaking."""
        held = list(self._held.values())
        oldest = min(held, key=lambda packet: packet.arrival_ns)
        corrected_ns = self.corrected_ns
        if corrected_ns is None or now_ns - corrected_ns > _CORRECTED_NS:
            return held
        if now_ns - oldest.arrival_ns >= LIVE_NS:
            return held
        return [packet for packet in held if packet.timestamp != oldest.timestamp]

    def _begin(self, sequence: int) -> None:
        self._expected = self._next = sequence

    def _note(self, packet: Packet) -> None:
        """Takes note of what is missing before the newest packet."""
        retransmission, now_ns = self.retransmission, packet.arrival_ns
        ahead = (packet.sequence - self._next) & 0xFFFF
        if packet.corrected:
            retransmission.corrected(packet.sequence)
        if ahead > MAX_JUMP:
            retransmission.came(packet.sequence, now_ns, again=False)
            return
        if ahead and retransmission.helps:
            retransmission.missed(self._next, ahead, now_ns - self._came_ns, now_ns)
        self._next = (packet.sequence + 1) & 0xFFFF
        self._came_ns = now_ns

    def _restart(self, packet: Packet) -> Iterator[tuple[Packet, int]]:
        """The sender began again if two packets in a row are far off; one alone is a stray."""
        before, self._jumped = self._jumped, packet
        if before is None or (before.sequence + 1) & 0xFFFF != packet.sequence:
            return
        self.retransmission.forget()
        yield from self._release(patient=False)
        self._jumped = None
        self._begin((packet.sequence + 1) & 0xFFFF)
        yield before, MAX_JUMP
        yield packet, 0

    def _release(self, *, patient: bool) -> Iterator[tuple[Packet, int]]:
        """What can go on: up to a gap, and beyond it if nothing in it can come any more."""
        awaits, helps = self.retransmission.awaits, self.retransmission.helps
        while self._held:
            assert self._expected is not None
            missing = 0
            if self._expected not in self._held:
                expected = self._expected
                if patient and (not helps or awaits(expected)):
                    return
                missing = min((number - expected) & 0xFFFF for number in self._held)
                if patient and any(awaits((expected + n) & 0xFFFF) for n in range(1, missing)):
                    return
                self._counters.packets_lost += missing
                self._wait_ns -= (self._wait_ns - _LEAST_WAIT_NS) // 4
                self._expected = (expected + missing) & 0xFFFF
            packet = self._held.pop(self._expected)
            self._expected = (self._expected + 1) & 0xFFFF
            yield packet, missing


@dataclass(frozen=True)
class AccessUnit:
    """One access unit in Annex B form, with the arrival of its last packet.

    `complete`: all of its packets are here; a slice of which only the beginning is stands in it up
    to where it was cut. `missing_before`: so many packets between the newest one of the one before
    and the first of this one are missing, so that what it refers to may be.
    """

    data: bytes
    complete: bool
    missing_before: int
    arrival_ns: int
    timestamp: int = 0
    """RTP's."""


class Depacketizer:
    """Packets in order into access units: single NAL units, STAP-A and FU-A."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._timestamp: int | None = None
        self._clear()

    def _clear(self) -> None:
        self._units = bytearray()
        self._fragment: bytearray | None = None
        self._complete = True
        self._missing_before = 0
        self._arrival_ns = 0

    def push(self, packet: Packet, missing: int) -> Iterator[AccessUnit]:
        """Access units that end with, or before, this packet; so many before it are missing."""
        if self._timestamp is not None and packet.timestamp != self._timestamp:
            # Its last packet was lost, or never had the marker.
            yield self._finish(complete=not missing)
        if missing:
            self._cut()
            if self._timestamp is None:
                self._missing_before = missing
            # Nothing of this one is missing if the packet after the gap is its first.
            self._complete = self._timestamp is None and _begins_access_unit(packet.payload)
        self._timestamp = packet.timestamp
        self._arrival_ns = max(self._arrival_ns, packet.arrival_ns)
        if not self._take(packet.payload):
            self._counters.malformed += 1
            self._complete = False
        if packet.marker:
            yield self._finish(complete=True)

    def _finish(self, *, complete: bool) -> AccessUnit:
        whole = complete and self._complete and self._fragment is None
        self._cut()
        unit = AccessUnit(
            bytes(self._units), whole, self._missing_before, self._arrival_ns, self._timestamp or 0
        )
        self._clear()
        self._timestamp = None
        return unit

    def _cut(self) -> None:
        """The rest of a unit does not come: of a slice the beginning can be decoded."""
        if self._fragment is not None and self._fragment[0] & 0x1F in (NAL_SLICE, NAL_IDR):
            self._units += START_CODE + self._fragment
        self._fragment = None

    def _take(self, payload: bytes) -> bool:
        kind = payload[0] & 0x1F
        if len(self._units) + len(payload) > MAX_ACCESS_UNIT_BYTES:
            return False
        if 1 <= kind <= 23:
            self._units += START_CODE + payload
            return self._fragment is None
        if kind == _STAP_A:
            return self._take_aggregate(payload)
        if kind == _FU_A and len(payload) > 2:
            return self._take_fragment(payload)
        return False

    def _take_aggregate(self, payload: bytes) -> bool:
        at = 1
        while at + 2 <= len(payload):
            (size,) = struct.unpack_from(">H", payload, at)
            at += 2
            if size == 0 or at + size > len(payload):
                return False
            self._units += START_CODE + payload[at : at + size]
            at += size
        return at == len(payload) and self._fragment is None

    def _take_fragment(self, payload: bytes) -> bool:
        indicator, header = payload[0], payload[1]
        if header & _FU_START:
            whole = self._fragment is None
            self._cut()
            self._fragment = bytearray([indicator & 0xE0 | header & 0x1F])
        elif self._fragment is None:
            return not self._complete  # its beginning was lost, and that is told already
        else:
            whole = True
        if len(self._fragment) + len(payload) > MAX_ACCESS_UNIT_BYTES:
            return False
        self._fragment += payload[2:]
        if header & _FU_END:
            self._units += START_CODE + self._fragment
            self._fragment = None
        return whole


def _begins_access_unit(payload: bytes) -> bool:
    """Whether a packet starts with a unit that only ever comes first (H.264, 7.4.1.2.3)."""
    kind = payload[0] & 0x1F
    if kind == _STAP_A and len(payload) > 3:
        kind = payload[3] & 0x1F
    return kind in (NAL_SPS, NAL_AUD)
