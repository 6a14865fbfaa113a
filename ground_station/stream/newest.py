"""A queue between threads for whom the newest matters more than all."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Keeps up to `most` items in their order; where there is no room, the newer half of them.

    So a moment's delay loses none, a longer one few, and whoever stays behind is never later than
    that. From any thread; `skipped` counts those that nobody took.
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
                for _ in range(len(self._items) - self._most // 2):
                    self._items.popleft()
                    self.skipped += 1
            self._items.append(item)
            self._there.notify()

    @property
    def last(self) -> T | None:
        """The newest that nobody took yet."""
        with self._there:
            return self._items[-1] if self._items else None

    def take(self, timeout_s: float) -> T | None:
        """The oldest that is kept; None when none comes in time."""
        with self._there:
            self._there.wait_for(lambda: self._items, timeout_s)
            return self._items.popleft() if self._items else None
