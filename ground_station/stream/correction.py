"""What corrections (RFC 5109) say about packets that are missing, as linear equations over GF(2).

Each says what the exclusive-or of some packets is, and each packet that comes is one more equation,
of itself alone. Eliminated as they come, one with a single packet left is that packet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from ground_station.stream import rtp
from pi_firmware.wire import ulpfec, video

_KEPT_PACKETS = 256
"""More than a frame that can still be shown has."""
_KEPT_EQUATIONS = 64
_MOST_MISSING = 2 * ulpfec.MOST_PROTECTED

_Key = tuple[int, int]
"""RTP timestamp and sequence number: no correction covers packets of two frames."""


@dataclass(frozen=True)
class _Equation:
    missing: frozenset[_Key]
    value: int

    def plus(self, other: _Equation) -> _Equation:
        return _Equation(self.missing ^ other.missing, self.value ^ other.value)


class Correction:
    """The newest packets of one stream and what is known of missing ones; for one thread."""

    def __init__(self) -> None:
        self.offered = False
        """Whether the sender said that it sends corrections: until then nothing is kept."""
        self._came: dict[_Key, rtp.Packet] = {}
        self._equations: dict[_Key, _Equation] = {}
        """By a packet that is missing in no other of them."""

    def take(self, packet: rtp.Packet) -> Iterator[rtp.Packet]:
        """Those that are found with this packet, sent once or again, or a correction."""
        if packet.corrects:
            correction = ulpfec.Correction.decode(packet.payload)
            if correction is not None:
                yield from self._add(self._equation(packet.timestamp, correction), packet)
        elif self.offered and packet.plain:
            key = packet.timestamp, packet.sequence
            self._keep(key, packet)
            if any(key in equation.missing for equation in self._equations.values()):
                yield from self._add(_Equation(frozenset({key}), _bits(packet)), packet)

    def _keep(self, key: _Key, packet: rtp.Packet) -> None:
        self._came[key] = packet
        if len(self._came) > _KEPT_PACKETS:
            del self._came[next(iter(self._came))]

    def _equation(self, timestamp: int, correction: ulpfec.Correction) -> _Equation:
        """What a correction says of those that are not here."""
        missing, value = set(), correction.value
        for sequence in correction.sequences:
            came = self._came.get((timestamp, sequence))
            if came is None:
                missing.add((timestamp, sequence))
            else:
                value ^= _bits(came)
        return _Equation(frozenset(missing), value)

    def _add(self, equation: _Equation, packet: rtp.Packet) -> Iterator[rtp.Packet]:
        """Eliminates with an equation; gives what is found, other than the packet itself."""
        for key in equation.missing & self._equations.keys():
            equation = equation.plus(self._equations[key])
        if not 0 < len(equation.missing) <= _MOST_MISSING:
            return
        pivot = next(iter(equation.missing))
        for key, other in list(self._equations.items()):
            if pivot in other.missing:
                self._equations[key] = other.plus(equation)
        self._equations[pivot] = equation
        for key, each in list(self._equations.items()):
            if len(each.missing) == 1:
                del self._equations[key]
                if key not in self._came and (found := _found(key, each.value, packet)):
                    self._keep(key, found)
                    yield found
            elif len(each.missing) > _MOST_MISSING:
                del self._equations[key]
        if len(self._equations) > _KEPT_EQUATIONS:
            del self._equations[next(iter(self._equations))]


def _bits(packet: rtp.Packet) -> int:
    second = packet.marker << 7 | video.PAYLOAD_TYPE
    return ulpfec.bits(second, packet.timestamp, packet.payload)


def _found(key: _Key, value: int, by: rtp.Packet) -> rtp.Packet | None:
    """The packet, as it was sent; None where it cannot have been."""
    datagram = ulpfec.packet(value, key[1], by.ssrc)
    packet = None if datagram is None else rtp.parse(datagram, by.arrival_ns, by.waited_ns)
    if packet is None or packet.timestamp != key[0]:
        return None
    return replace(packet, corrected=True)
