"""When a recording's frames are handed over, and which running time each one gets."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

from pi_firmware.sources.window import Window

PACES = ("realtime", "stepped")
MAX_STEPS_HZ = 120.0
"""Frames a second of the stepped pace where `max_hz` says nothing.

UDP has no back-pressure, so this is what keeps a receiver from being flooded: at the default bit
rate 120 frames a second are the packets of a flight at 8 Mbit/s. Of 2,000 frames of the sample
flight over loopback none was lost at it, nor at the 146 to 153 a second of two cores without it,
with a receive buffer of 4 MB as with one of 208 kB.
"""


class Pace(Protocol):
    """Waits for each frame's turn."""

    ahead_frames: int
    """How many frames may wait in front of the pipeline."""

    def turn(self, time_ns: int) -> int | None:
        """Waits for the turn of the frame captured at `time_ns`, the first frame's being at once.

        Returns its running time in the pipeline, ns; None when the waiting was interrupted.
        """
        ...


class RealTime:
    """Each frame at its recorded instant, `speed` times as fast, on the pipeline's clock."""

    ahead_frames = 4

    def __init__(self, speed: float, now: Callable[[], int], stopping: threading.Event) -> None:
        self._speed = speed
        self._now = now
        self._stopping = stopping
        self._start: tuple[int, int] | None = None

    def turn(self, time_ns: int) -> int | None:
        if self._start is None:
            self._start = self._now(), time_ns
        start_ns, first_ns = self._start
        due_ns = start_ns + int((time_ns - first_ns) / self._speed)
        interrupted = self._stopping.wait(max(0, due_ns - self._now()) / 1e9)
        return None if interrupted else due_ns


class Stepped:
    """Each frame when the pipeline has taken the one before, at most `max_hz` a second.

    With a window it also waits for whoever works on the frames.

    Running time is the recording's, not the clock's: whatever is measured in it (heartbeats, IDR
    intervals, the encoder's bit rate) comes out as in a flight, the same in each run.
    """

    ahead_frames = 1

    def __init__(
        self, max_hz: float, stopping: threading.Event, window: Window | None = None
    ) -> None:
        self._least_s = 1 / max_hz
        self._stopping = stopping
        self._window = window
        self._first_ns: int | None = None
        self._previous_s = -self._least_s

    def turn(self, time_ns: int) -> int | None:
        if self._first_ns is None:
            self._first_ns = time_ns
        else:
            wait_s = self._previous_s + self._least_s - time.monotonic()
            if wait_s > 0 and self._stopping.wait(wait_s):
                return None
        if self._window is not None and not self._window.wait(self._stopping):
            return None
        self._previous_s = time.monotonic()
        return None if self._stopping.is_set() else time_ns - self._first_ns
