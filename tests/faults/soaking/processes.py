"""What processes hold of the machine: memory and file descriptors, read from proc(5)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

from soaking.measures import DESCRIPTORS, MEMORY, Measure

Bounds = tuple[float | None, float | None]
"""Slopes an hour that would matter, of memory in MB and of descriptors; None: not judged."""


def memory_MB(pid: int) -> float | None:
    """A process's resident memory (statm); None when it has gone."""
    with contextlib.suppress(OSError):
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        if pages:  # an ended one that nobody reaped yet has none
            return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return None


def descriptors(pid: int) -> int | None:
    """How many files, sockets and pipes it has open; None when it has gone, or is another's."""
    with contextlib.suppress(OSError):
        return sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return None


class Watch:
    """Memory and descriptors of named processes over time; `measures` has both of each.

    `bounds` is by name; a name that is not there is drawn only, as is what is too young to judge.
    A process that was restarted under its name is told by `changed`.
    """

    def __init__(self, bounds: Mapping[str, Bounds]) -> None:
        self._bounds = dict(bounds)
        self._measures: dict[str, tuple[Measure, Measure]] = {}
        self._pids: dict[str, int] = {}
        self.changed: dict[str, int] = {}
        """How often a name was seen with another process than before."""

    def sample(self, at_s: float, pids: Mapping[str, int]) -> None:
        """What each holds now; names that are known and missing have no value now."""
        for name, pid in pids.items():
            if self._pids.setdefault(name, pid) != pid:
                self.changed[name] = self.changed.get(name, 0) + 1
                self._pids[name] = pid
        for name in {**self._measures, **pids}:
            memory, files = self._of(name)
            now = pids.get(name)
            memory.add(at_s, None if now is None else memory_MB(now))
            files.add(at_s, None if now is None else descriptors(now))

    @property
    def measures(self) -> list[Measure]:
        """Memory of all, then descriptors of all."""
        both = list(self._measures.values())
        return [memory for memory, _ in both] + [files for _, files in both]

    def last_MB(self) -> dict[str, float]:
        """The newest memory of each."""
        return {name: memory.points[-1][1] for name, (memory, _) in self._measures.items()}

    def _of(self, name: str) -> tuple[Measure, Measure]:
        if name not in self._measures:
            memory, files = self._bounds.get(name, (None, None))
            self._measures[name] = (
                Measure(MEMORY, name, "MB", memory),
                Measure(DESCRIPTORS, name, "files", files, step=1.0),
            )
        return self._measures[name]
