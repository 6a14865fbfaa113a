"""Where the threads of bus, server and maps leave what the process's loop takes."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from ground_station.service.bus_messages import FrameMessage

Task = Callable[[], object]
_MOST = 2000


class Inbox:
    """Tasks in their order, at most 2000, and the newest frame of each payload.

    Never blocks who puts; `dropped` counts the tasks that a full inbox lost, the oldest first, and
    `skipped` the frames that a newer one replaced. Safe from any thread.
    """

    def __init__(self) -> None:
        self.dropped = self.skipped = 0
        self._tasks: deque[Task] = deque()
        self._frames: dict[str, FrameMessage] = {}
        self._there = threading.Condition()

    def put(self, task: Task) -> None:
        """Leaves a task."""
        with self._there:
            if len(self._tasks) >= _MOST:
                self._tasks.popleft()
                self.dropped += 1
            self._tasks.append(task)
            self._there.notify()

    def frame(self, payload_id: str, note: FrameMessage) -> None:
        """Leaves a payload's newest frame."""
        with self._there:
            self.skipped += payload_id in self._frames
            self._frames[payload_id] = note
            self._there.notify()

    def take(self, timeout_s: float) -> tuple[list[Task], dict[str, FrameMessage]]:
        """All there is; waits for something to come."""
        with self._there:
            self._there.wait_for(lambda: self._tasks or self._frames, timeout_s)
            tasks, frames = list(self._tasks), self._frames
            self._tasks.clear()
            self._frames = {}
            return tasks, frames
