"""When a frame was taken whose own word of it was lost: by the RTP clock, from those before it."""

from __future__ import annotations

from dataclasses import replace

from ground_station.stream.rtp import CLOCK_HZ
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

    def reckon(self, timestamp: int) -> FrameInfo | None:
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
