"""One process of the payload in a flight of several, and what left it."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from payload_process import Ended, PayloadProcess
from witness import Witness

from ground_station.stream import rtp
from scenarios.camera import Camera

UNBORN_S = 2.0
"""An interpreter that has not come to the program's first line by then hangs."""
_KEPT_PACKETS = 2000


class Watch(Witness):
    """The tap of a link for one payload: also keeps when each frame left, and the last packets."""

    def __init__(self) -> None:
        super().__init__()
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

    ssrc: int
    camera: Camera
    process: PayloadProcess
    began_s: float
    folder: Path
    watch: Watch = field(default_factory=Watch)
    ended: Ended | None = None
    killed: bool = False
    ended_s: float = float("inf")
    card: list[str] = field(default_factory=list)
    """Files on the card when it began: the others are its own."""

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
