"""What the payload asks of a camera."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

from pi_firmware.wire.errors import BlimpError, StreamError

PATIENCE_S = 30.0
"""Without an answer for this long nobody is taken to answer; a search of a whole map is shorter."""
_POLL_S = 0.2


class Window:
    """At most `ahead` frames are on their way; each pose from the ground makes room for another.

    UDP has no back-pressure: the poses that come back are it. Frames that never leave the payload
    take no room, and a pose answers all frames before its own, too, so that a lost one holds
    nothing up. Safe from any thread.
    """

    def __init__(self, ahead: int, patience_s: float = PATIENCE_S) -> None:
        self._ahead = ahead
        self._patience_s = patience_s
        self._open: deque[int] = deque()
        self._changed = threading.Condition()

    def passed(self, sequence: int) -> None:
        """This frame goes to the encoder; sequences rise."""
        with self._changed:
            self._open.append(sequence)

    def gone(self, sequence: int) -> None:
        """This frame will never leave the payload."""
        with self._changed:
            if sequence in self._open:
                self._open.remove(sequence)
                self._changed.notify_all()

    def answered(self, sequence: int) -> None:
        """The ground is done with this frame and all before it."""
        with self._changed:
            while self._open and self._open[0] <= sequence:
                self._open.popleft()
            self._changed.notify_all()

    def wait(self, stopping: threading.Event) -> bool:
        """Waits until there is room; False when the waiting was interrupted.

        Raises `StreamError` when no answer came for `patience_s`.
        """
        since_s = time.monotonic()
        with self._changed:
            oldest = self._open[0] if self._open else None
            while len(self._open) >= self._ahead:
                if stopping.is_set():
                    return False
                if self._open[0] != oldest:
                    oldest, since_s = self._open[0], time.monotonic()
                if time.monotonic() - since_s > self._patience_s:
                    raise StreamError(
                        f"no pose came back for frame {oldest} within {self._patience_s:g} s;"
                        " 'ahead' is for a ground station that answers each frame"
                    )
                self._changed.wait(_POLL_S)
        return not stopping.is_set()


@dataclass(frozen=True)
class Stamp:
    """When a frame was captured, and with what exposure.

    `time_ns`, since 1970, is the middle of the exposure of the picture's middle row: the instant
    whose pose the ground station estimates, from which it counts the other rows of a rolling
    shutter. A live camera's timestamp is brought there by the sensor's readout and exposure, as far
    as these are known (`live.to_middle_ns`); a recording's capture times are this already.
    `clock_ns` is the payload's clock at that instant; in a replay, when the frame was handed over.
    `exposure_s`, of each row, and `gain` are None where the device does not tell.
    """

    time_ns: int
    clock_ns: int
    exposure_s: float | None = None
    gain: float | None = None


class Source(Protocol):
    """Frames for the pipeline; whichever camera they come from.

    The pipeline is built from `elements`, `attach`ed, set to playing, and then `start`ed. The
    source ends the stream itself when it has no more frames, or when `stop` is called.
    """

    rate_hz: float
    """Frames captured a second."""

    cut_reason: str = ""
    """Why a recording ended early, in words; empty when it did not."""

    error: BlimpError | None = None
    """What ended the source for good, when it was not its end: opening it again would not help.

    None where the pipeline's error is one of the moment, as of a camera that was unplugged.
    """

    dmabuf: bool = False
    """Whether the pictures are dmabufs, which a hardware encoder reads without a copy."""

    window: Window | None = None
    """Told of each frame that passes the gate, where the source waits for the ground's answers."""

    def elements(self) -> str:
        """The pipeline's text from the source to raw I420 or NV12 at the camera's size and rate."""
        ...

    def attach(self, pipeline: Any) -> None:
        """Takes the pipeline that was built, before it plays."""
        ...

    def start(self) -> None:
        """Begins to deliver frames into the playing pipeline."""
        ...

    def stamp(self, running_ns: int) -> Stamp:
        """The capture times of the frame that has this running time in the pipeline."""
        ...

    def explain(self, message: str) -> str:
        """GStreamer's error message, in words of this source where it has better ones."""
        return message

    def stop(self) -> None:
        """Ends the stream: what was delivered still flows through."""
        ...

    def close(self) -> None:
        """Releases threads and files, after the pipeline has stopped."""
        ...
