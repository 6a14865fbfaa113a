"""What waits for the disk: handed over without waiting, bounded in bytes."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from pi_firmware.wire import annexb, sei

_ITEM_BYTES = 512
"""What an item takes beside a unit's bytes, about; any other as a whole."""


@dataclass(frozen=True, slots=True)
class Unit:
    """An access unit, and when it came, by the monotonic clock.

    `stream` tells apart the cameras of a recording; `log_ns` is its log time where that is not its
    capture time.
    """

    info: sei.FrameInfo
    data: bytes
    arrived_s: float
    stream: str = ""
    log_ns: int | None = None


class Queue:
    """A queue from many threads to one.

    When a unit does not fit, it and all that follow of its stream are left out up to an IDR that
    finds the queue half empty: what is recorded of a group of pictures is always its beginning, so
    it decodes.
    """

    def __init__(self, limit_bytes: int, wake_bytes: int) -> None:
        self.left_out = 0
        """Units that were not taken."""
        self._limit_bytes, self._wake_bytes = limit_bytes, wake_bytes
        self._items: deque[tuple[int, object]] = deque()
        self._bytes = 0
        self._skipping: set[str] = set()
        self._closed = self._broken = False
        self._lock = threading.Lock()
        self._wake = threading.Event()

    def unit(
        self, info: sei.FrameInfo, access_unit: bytes, stream: str = "", log_ns: int | None = None
    ) -> None:
        """Queues an access unit, or counts it as left out."""
        size = len(access_unit) + _ITEM_BYTES
        with self._lock:
            if self._closed:
                self.left_out += self._broken
                return
            takes = self._bytes + size <= self._limit_bytes
            if stream in self._skipping:
                # Only now does anyone look into the unit: the encoder's thread has little time.
                calm = self._bytes <= self._limit_bytes // 2
                takes = takes and calm and annexb.is_idr(access_unit)
            if takes:
                self._skipping.discard(stream)
                self._add(Unit(info, access_unit, time.monotonic(), stream, log_ns), size)
            else:
                self._skipping.add(stream)
                self.left_out += 1

    def put(self, item: object, size_bytes: int = 0) -> None:
        """Queues anything else, of so many bytes beside itself; a full queue does not take it."""
        size = size_bytes + _ITEM_BYTES
        with self._lock:
            if not self._closed and self._bytes + size <= self._limit_bytes:
                self._add(item, size)

    def wait(self, until_s: float) -> bool:
        """Until this monotonic time, or until much waits; whether the end has come."""
        self._wake.wait(max(0.0, until_s - time.monotonic()))
        if not self._closed:
            self._wake.clear()
        return self._closed

    def take(self) -> object | None:
        """The oldest item, None when there is none."""
        with self._lock:
            if not self._items:
                return None
            size, item = self._items.popleft()
            self._bytes -= size
            return item

    def close(self, *, broken: bool = False) -> None:
        """From now on nothing is taken; what waits can still be.

        `broken`: nobody asked for it, so units that come until all know of it are left out, too.
        """
        with self._lock:
            self._broken = self._broken or (broken and not self._closed)
            self._closed = True
        self._wake.set()

    def clear(self) -> None:
        """Leaves out what still waits."""
        with self._lock:
            self.left_out += sum(isinstance(item, Unit) for _, item in self._items)
            self._items.clear()
            self._bytes = 0

    def _add(self, item: object, size: int) -> None:
        self._items.append((size, item))
        self._bytes += size
        if self._bytes >= self._wake_bytes:
            self._wake.set()
