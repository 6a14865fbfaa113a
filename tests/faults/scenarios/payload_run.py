"""One process of the payload in a flight of several, and what left it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from payload_process import Ended, PayloadProcess
from witness import Witness

from ground_station.stream import rtp
from scenarios.camera import Camera

UNBORN_S = 2.0
"""An interpreter that has not come to the program's first line by then hangs."""
_KEPT_PACKETS = 2000
_SSRC = re.compile(r" ssrc (\d+)\n")


class Watch(Witness):
    """The tap of a link for one payload: also keeps when each frame left, and the last packets."""

    def __init__(self, keys: Mapping[str, bytes]) -> None:
        super().__init__(keys)
        self.at_s: list[float] = []
        """When each frame of `left` had left whole, `time.monotonic`."""
        self.recent: deque[tuple[float, bytes]] = deque(maxlen=_KEPT_PACKETS)

    def __call__(self, datagram: bytes, lost: bool) -> None:
        self.recent.append((time.monotonic(), datagram))
        super().__call__(datagram, lost)

    def _follow(self, packet: rtp.Packet, lost: bool) -> None:
        super()._follow(packet, lost)
        frames = sum(len(stream.frames) for stream in self._streams.values())
        self.at_s += [time.monotonic()] * (frames - len(self.at_s))


@dataclass
class PayloadRun:
    """From its start to its end, which may have been a SIGKILL (`killed`)."""

    camera: Camera
    process: PayloadProcess
    began_s: float
    watch: Watch
    card: list[str]
    """Files on the card when it began: the others are its own."""
    ended: Ended | None = None
    killed: bool = False
    ended_s: float = float("inf")
    _ssrc: int = field(default=0, init=False)

    @property
    def ssrc(self) -> int:
        """Its stream's, which it draws and says; 0 before."""
        if not self._ssrc and (said := _SSRC.search(self.process.written())):
            self._ssrc = int(said[1])
        return self._ssrc

    @property
    def unborn(self) -> bool:
        """Whether it was ended before its first line of Python ran: SIGTERM had no handler yet."""
        return (
            self.ended is not None
            and self.ended.status == -signal.SIGTERM
            and not self.ended.out
            and self.ended_s - self.began_s < UNBORN_S
        )

    def send(self, number: signal.Signals) -> None:
        """A signal, if it still runs."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process.pid, number)

    def end(self) -> None:
        """SIGTERM, and its end."""
        self._end(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL, as when its cell's contact is lost."""
        self.killed = True
        self._end(signal.SIGKILL)

    def note_end(self) -> None:
        """It has ended by itself."""
        self._end(None)

    def _end(self, number: signal.Signals | None) -> None:
        if self.ended is None:
            self.send(signal.SIGCONT)  # one that stands would never hear of it
            self.ended_s = time.monotonic()
            self.ended = self.process.end(number)
