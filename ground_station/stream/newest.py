"""A queue between threads for whom the newest matters more than all."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Keeps up to `most` items in their order; where there is no room, the newest only.

    So a moment's delay loses none, and whoever stays behind is not late for ever. From any thread;
    `skipped` counts those that nobody took.
    """

    def __init__(self, most: int = 1) -> None:
        self.skipped = 0
        self._most = most
        self._items: deque[T] = deque()
        self._there = threading.Condition()

    def put(self, item: T) -> None:
        """Takes one."""
        with self._there:
            if len(self._items) >= self._most:
                self.skipped += len(self._items)
                self._items.clear()
            self._items.append(item)
            self._there.notify()

    def take(self, timeout_s: float) -> T | None:
        """The oldest that is kept; None when none comes in time."""
        with self._there:
            self._there.wait_for(lambda: self._items, timeout_s)
            return self._items.popleft() if self._items else None
