"""A queue between threads for whom the newest matters more than all."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Keeps up to `most` items in their order; where there is no room, the newer half of them.

    One that has waited for longer than `oldest_s` is let go of where there is a newer one. So a
    moment's delay loses none, a longer one few, and whoever stays behind is never later than that.
    From any thread; `skipped` counts those that nobody took.
    """

    def __init__(self, most: int = 1, oldest_s: float = math.inf) -> None:
        self.skipped = 0
        self._most, self._oldest_s = most, oldest_s
        self._items: deque[tuple[float, T]] = deque()
        self._there = threading.Condition()

    def put(self, item: T) -> None:
        """Takes one."""
        with self._there:
            if len(self._items) >= self._most:
                self._skip(len(self._items) - self._most // 2)
            self._items.append((time.monotonic(), item))
            self._there.notify()

    def take(self, timeout_s: float) -> T | None:
        """The oldest that is kept; None when none comes in time."""
        with self._there:
            self._there.wait_for(lambda: self._items, timeout_s)
            while len(self._items) > 1 and self._waiting_s() > self._oldest_s:
                self._skip(1)
            return self._items.popleft()[1] if self._items else None

    @property
    def waiting_s(self) -> float:
        """How long the oldest has waited; 0 where there is none."""
        with self._there:
            return self._waiting_s() if self._items else 0.0

    def _waiting_s(self) -> float:
        return time.monotonic() - self._items[0][0]

    def _skip(self, count: int) -> None:
        for _ in range(count):
            self._items.popleft()
        self.skipped += count
