"""How far a stepped recording may run ahead of who works on its frames."""

from __future__ import annotations

import threading
import time
from collections import deque

from pi_firmware.wire.errors import StreamError

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
