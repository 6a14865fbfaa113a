"""A queue between threads for whom the newest matters more than all."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Keeps the `most` newest items, from any thread; `skipped` counts those that nobody took."""

    def __init__(self, most: int = 1) -> None:
        self.skipped = 0
        self._items: deque[T] = deque(maxlen=most)
        self._there = threading.Condition()

    def put(self, item: T) -> None:
        """Takes one, in place of the oldest where there is no room."""
        with self._there:
            self.skipped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._there.notify()

    def take(self, timeout_s: float) -> T | None:
        """The oldest that is kept; None when none comes in time."""
        with self._there:
            self._there.wait_for(lambda: self._items, timeout_s)
            return self._items.popleft() if self._items else None
