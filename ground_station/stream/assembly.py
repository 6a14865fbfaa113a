"""One stream's packets into its frames: in order, whole, decoded, each with its capture time."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ground_station.arrays import Bools
from ground_station.recording.frames import plausible_exposure_s
from ground_station.stream import rtp
from ground_station.stream.arrivals import Arrivals
from ground_station.stream.correction import Correction
from ground_station.stream.counters import Counters
from ground_station.stream.decoder import Decoder
from ground_station.stream.rtp import CLOCK_HZ
from pi_firmware.wire import annexb, sei
from pi_firmware.wire.sei import FrameInfo

_TICK_NS = 1e9 / CLOCK_HZ
_MOST_OFF_NS = 2_000_000
"""The camera's clock against the RTP clock from frame to frame: a blimp goes millimetres in it."""
_MOST_OFF = 0.2
"""Of a frame's interval: a camera's frames are further apart, and so none is taken for another."""
_MOST_APART_S = 0.5


class Stamps:
    """The two newest frames of one stream that had their numbers with them."""

    def __init__(self) -> None:
        self._known: list[tuple[int, FrameInfo]] = []

    def take(self, timestamp: int, info: FrameInfo) -> None:
        """A frame's RTP timestamp and numbers."""
        self._known = [*self._known[-1:], (timestamp, info)]

    def estimate(self, timestamp: int) -> FrameInfo | None:
        """The numbers of a frame with this timestamp; None where they are not certain.

        Its exposure and what the gate saw of it are those of the frame before.
        """
        if len(self._known) < 2:
            return None
        (first, before), (last, info) = self._known
        frames = info.sequence - before.sequence
        ticks, ahead = (last - first) & 0xFFFFFFFF, (timestamp - last) & 0xFFFFFFFF
        elapsed_ns = ticks * _TICK_NS
        if frames <= 0 or ticks == 0 or max(ticks, ahead) * _TICK_NS > _MOST_APART_S * 1e9:
            return None
        for told_ns in (info.time_ns - before.time_ns, info.clock_ns - before.clock_ns):
            if abs(told_ns - elapsed_ns) > _MOST_OFF_NS:
                return None
        step = ahead * frames / ticks
        if round(step) < 1 or abs(step - round(step)) > _MOST_OFF:
            return None
        since_ns = round(ahead * _TICK_NS)
        return replace(
            info,
            sequence=info.sequence + round(step),
            time_ns=info.time_ns + since_ns,
            clock_ns=info.clock_ns + since_ns,
        )


_SETS_TIMEOUT_NS = 3_000_000_000
"""A stream that has come for so long without parameter sets cannot be shown."""

_TOO_MANY_LOST = 0.05
"""Of a stream's packets: where more are lost that is why, and not how it is encoded."""


@dataclass(frozen=True, kw_only=True)
class ReceivedFrame(sei.FrameInfo):
    """One frame as captured, with its numbers.

    `time_ns` is the camera's capture time, `clock_ns` the payload's clock then, `arrival_ns` this
    machine's wall clock (`time.time_ns`) when the frame's last packet arrived. `image` is gray
    (H, W) uint8. `exposure_s` is None where the payload does not tell it or what it tells cannot
    be. `access_unit` is what it was decoded from, Annex B with its SEI. `damaged` (rows, columns of
    macroblocks) is what a loss since the last whole IDR took of it; None where nothing was lost.
    """

    image: NDArray[np.uint8]
    arrival_ns: int
    ssrc: int
    access_unit: bytes = b""
    damaged: Bools | None = None

    @property
    def info(self) -> sei.FrameInfo:
        """Its numbers alone: who keeps them keeps no picture."""
        names = (one.name for one in fields(sei.FrameInfo))
        return sei.FrameInfo(**{name: getattr(self, name) for name in names})


class Assembly:
    """What belongs to one SSRC from its first packet to its last; for one thread.

    It gives out only what the payload sent, and says what of a frame is not: none is painted over a
    loss, none is without capture time. All else is counted in `counters`.
    """

    def __init__(self, ssrc: int, counters: Counters) -> None:
        self.ssrc = ssrc
        self.last_arrival_ns = 0
        """Monotonic, of the newest packet."""
        self.arrivals = Arrivals()
        """How its packets come, for whoever sends them."""
        self.correction = Correction()
        """What is found of it from corrections."""
        self._counters = counters
        self._reorderer = rtp.Reorderer(counters)
        self.retransmission = self._reorderer.retransmission
        self._depacketizer = rtp.Depacketizer(counters)
        self._decoder = Decoder(counters)
        self._stamps = Stamps()
        self._first_arrival_ns: int | None = None

    @property
    def holds(self) -> bool:
        """Whether packets wait for what is missing before them."""
        return self._reorderer.holds

    @property
    def problem(self) -> str | None:
        """Why the stream cannot be shown, in words; None while it can."""
        if self._first_arrival_ns is None or self._decoder.saw_parameter_sets:
            return None
        came_ns = self.last_arrival_ns - self._first_arrival_ns
        if came_ns <= _SETS_TIMEOUT_NS:
            return None
        counters = self._counters
        sent, lost = counters.packets - counters.packets_late, counters.packets_lost
        sent += lost  # those that came too late are among the lost
        if lost <= _TOO_MANY_LOST * sent:
            return annexb.NO_PARAMETER_SETS
        return (
            f"no picture came whole in {came_ns / 1e9:.0f} s: of {sent} packets {lost} were lost or"
            " came too late"
        )

    def push(self, packet: rtp.Packet) -> Iterator[ReceivedFrame]:
        """Takes a packet, sent once or again, or a correction; the frames whole with it."""
        self.arrivals.add(packet)
        self.last_arrival_ns = packet.arrival_ns
        if self._first_arrival_ns is None:
            self._first_arrival_ns = packet.arrival_ns
        if packet.corrects:
            self._counters.corrections += 1
            self._reorderer.corrected_ns = packet.arrival_ns
        else:
            self._counters.packets += not packet.again
            yield from self._assemble(self._reorderer.push(packet))
        for found in self.correction.take(packet):
            yield from self._assemble(self._reorderer.push(found))

    def expire(self, now_ns: int) -> Iterator[ReceivedFrame]:
        """The frames that are whole because what is missing before them is given up."""
        yield from self._assemble(self._reorderer.expire(now_ns))

    def _assemble(self, ordered: Iterable[tuple[rtp.Packet, int]]) -> Iterator[ReceivedFrame]:
        units = (unit for each in ordered for unit in self._depacketizer.push(*each))
        for unit in units:
            self._counters.access_units += 1
            unit = self._decoder.with_sets(unit)
            picture = self._decoder.decode(unit)
            if picture is None:
                continue
            data, info = unit.data, sei.find(unit.data)
            if info is not None:
                self._stamps.take(unit.timestamp, info)
            elif not unit.complete and (info := self._stamps.estimate(unit.timestamp)) is not None:
                data = annexb.insert_before_slice(data, sei.encode(info))
            if info is None or min(info.time_ns, info.clock_ns) < 0:
                self._counters.unstamped += 1
                continue
            if picture.damaged is None:
                self._counters.decoded += 1
            else:
                self._counters.damaged += 1
            since_ns = time.monotonic_ns() - unit.arrival_ns
            info = replace(info, exposure_s=plausible_exposure_s(info.exposure_s))
            yield ReceivedFrame(
                **vars(info),
                image=picture.image,
                arrival_ns=time.time_ns() - since_ns,
                ssrc=self.ssrc,
                access_unit=data,
                damaged=picture.damaged,
            )
