"""The tasks of the payload as data, their heartbeats, and the thread that runs one."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

_REPEAT_S = 60.0  # the same fault is told again after this long, with its count
_JOIN_LIMIT_S = 2.0


@dataclass(frozen=True)
class Task:
    """A task that beats about every `period_s` and is late after `watchdog_s` without a beat."""

    name: str
    period_s: float
    watchdog_s: float


class Table:
    """When each task was last heard of. Safe from any thread.

    A task is watched from its first beat, as it begins, until `end`: one that this flight does
    without is never late. An unknown name is a `KeyError`.
    """

    def __init__(self, tasks: Iterable[Task], clock: Callable[[], float] = time.monotonic) -> None:
        self._tasks = {task.name: task for task in tasks}
        self._clock = clock
        self._lock = threading.Lock()
        self._heard: dict[str, float] = {}

    def __getitem__(self, name: str) -> Task:
        return self._tasks[name]

    def beat(self, name: str) -> None:
        """The task begins, or has done its work once more."""
        with self._lock:
            self._heard[self._tasks[name].name] = self._clock()

    def end(self, name: str) -> None:
        """The task has ended in order and is no longer watched."""
        with self._lock:
            self._heard.pop(self._tasks[name].name, None)

    def ages(self) -> dict[str, float]:
        """Seconds since each running task's last beat, in the table's order."""
        with self._lock:
            now = self._clock()
            return {name: now - self._heard[name] for name in self._tasks if name in self._heard}

    def late(self) -> list[str]:
        """Running tasks that missed their watchdog, in the table's order."""
        ages = self.ages()
        return [name for name, age_s in ages.items() if age_s > self._tasks[name].watchdog_s]


class PeriodicThread:
    """Runs `call` each period of a task of the table, on a thread of its own.

    A call that returns is a beat; one that raises is reported as one line and tried again at the
    next period, so that a task that always fails becomes late. The same line is reported once a
    minute at most. Periods that a long call has missed are not made up for.
    """

    def __init__(
        self,
        table: Table,
        name: str,
        call: Callable[[], object],
        report: Callable[[str], object],
    ) -> None:
        self._table, self._task = table, table[name]
        self._call, self._report = call, report
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._last_fault = ""
        self._told_at = 0.0
        self._unsaid = 0

    def start(self) -> None:
        """Starts the thread, whose first call is at once; a second call does nothing."""
        if self._thread is None:
            self._table.beat(self._task.name)
            self._thread = threading.Thread(target=self._run, name=self._task.name, daemon=True)
            self._thread.start()

    def stop(self, limit_s: float = _JOIN_LIMIT_S) -> bool:
        """Ends the thread, waiting `limit_s` at most; whether it has ended."""
        self._end.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(limit_s)
        ended = thread is None or not thread.is_alive()
        if ended:
            self._table.end(self._task.name)
        return ended

    def _run(self) -> None:
        due = time.monotonic()
        while not self._end.is_set():
            try:
                self._call()
            except Exception as error:  # whatever it is, a flight does not end for one task
                self._fault(f"{self._task.name}: {type(error).__name__}: {error}")
            else:
                self._table.beat(self._task.name)
            now = time.monotonic()
            due = max(due + self._task.period_s, now)
            self._end.wait(due - now)

    def _fault(self, line: str) -> None:
        line = " ".join(line.split())
        now = time.monotonic()
        if line == self._last_fault and now - self._told_at < _REPEAT_S:
            self._unsaid += 1
            return
        again = f" ({self._unsaid} times more)" if line == self._last_fault and self._unsaid else ""
        self._last_fault, self._told_at, self._unsaid = line, now, 0
        with contextlib.suppress(Exception):  # telling of it may fail, too
            self._report(line + again)
