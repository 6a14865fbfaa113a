"""What a process takes of its machine, watched from outside for as long as a run lasts."""

from __future__ import annotations

import os
import re
import threading
from dataclasses import dataclass
from pathlib import Path

_PERIOD_S = 0.2
_PEAK = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)


@dataclass(frozen=True)
class Side:
    """One side's resources: peak resident memory (MB of 10^6), processor time as a share of one
    core over the run; None where it is not known. `source` says who measured it.
    """

    memory_MB: float | None = None
    cpu: float | None = None
    source: str = ""


class Watch:
    """Watches a process of this machine (`os.getpid()`: this one) between enter and exit.

    Its last reading before the process ends counts: at most a fifth of a second is missed.
    """

    def __init__(self, pid: int) -> None:
        self._proc = Path(f"/proc/{pid}")
        self._peak_MB: float | None = None
        self._first: tuple[float, float] | None = None
        self._last: tuple[float, float] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"watch-{pid}", daemon=True)

    def __enter__(self) -> Watch:
        self._read()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._read()

    def side(self) -> Side:
        """What was found so far."""
        cpu = None
        if self._first is not None and self._last is not None:
            wall_s = self._last[0] - self._first[0]
            cpu = (self._last[1] - self._first[1]) / wall_s if wall_s > 0 else None
        return Side(self._peak_MB, cpu, "/proc")

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S):
            self._read()

    def _read(self) -> None:
        """Takes a reading (proc(5)); none of a process that has gone or is a zombie."""
        try:
            peak = _PEAK.search((self._proc / "status").read_text())
            words = (self._proc / "stat").read_text().rpartition(")")[2].split()
            uptime_s = float(Path("/proc/uptime").read_text().split()[0])
        except (OSError, IndexError, ValueError):
            return
        if peak is None:
            return
        used_s = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        self._peak_MB = int(peak[1]) * 1.024e-3
        self._last = (uptime_s, used_s)
        if self._first is None:
            self._first = self._last
