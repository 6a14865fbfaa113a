"""How much a machine with other work slows down who is watched: bounds in seconds depend on it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

MOST = 5.0
"""No bound is stretched farther."""


class Burden:
    """Follows threads of processes: how long they ran, and how long they waited for a processor."""

    def __init__(self) -> None:
        self._last: dict[tuple[int, int], tuple[int, int]] = {}
        self._ran_ns = self._waited_ns = 0

    def look(self, pids: Iterable[int]) -> None:
        """Adds what they did since the last look (proc(5), schedstat)."""
        now = {key: times for pid in pids for key, times in _threads(pid)}
        for key, (ran_ns, waited_ns) in now.items():
            if key in self._last:
                self._ran_ns += ran_ns - self._last[key][0]
                self._waited_ns += waited_ns - self._last[key][1]
        self._last = now

    @property
    def factor(self) -> float:
        """How many times longer they took than with a processor for each thread, 1 to `MOST`."""
        if self._ran_ns <= 0:
            return 1.0
        return min(MOST, 1.0 + max(0, self._waited_ns) / self._ran_ns)


def _threads(pid: int) -> Iterable[tuple[tuple[int, int], tuple[int, int]]]:
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, ValueError):
                ran_ns, waited_ns, _ = map(int, (task / "schedstat").read_text().split())
                yield (pid, int(task.name)), (ran_ns, waited_ns)
