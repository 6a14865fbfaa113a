"""Less processor for a process and all that it has started or will start: by the kernel where it
can, else by stopping them in turns.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Collection, Iterator
from pathlib import Path

PERIOD_S = 0.010
"""The kernel's period: short, so that a process gets slower rather than stopping for long."""
TURN_S = 0.020
"""The period of stopping and going on, which a program keeps less exactly than a kernel."""

CGROUP2, CGROUP1, STOPPING = "cgroup v2, cpu.max", "cgroup v1, cpu.cfs_quota_us", "SIGSTOP/SIGCONT"


class Group:
    """A control group of one's own with a share of the processor, of all cores together.

    A context manager; it gives its processes back to the group that they came from.
    """

    def __init__(self, parent: Path, version: int) -> None:
        self._parent = parent
        self._version = version
        self.folder = parent / f"blimp-limits-{os.getpid()}-{id(self):x}"

    def __enter__(self) -> Group:
        self.folder.mkdir()
        return self

    def limit(self, cores: float) -> None:
        """Raises `OSError` where this user may not, or there is no such controller."""
        period_us, quota_us = int(1e6 * PERIOD_S), max(1000, int(1e6 * PERIOD_S * cores))
        if self._version == 2:
            self._write("cpu.max", f"{quota_us} {period_us}")
        else:
            self._write("cpu.cfs_period_us", str(period_us))
            self._write("cpu.cfs_quota_us", str(quota_us))

    def take(self, pid: int) -> None:
        """Moves a process with all its threads into the group."""
        self._write("cgroup.procs", str(pid))

    def _write(self, name: str, text: str) -> None:
        path = self.folder / name
        if not path.exists():  # writing must not make it
            raise FileNotFoundError(path)
        path.write_text(text)

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            for pid in (self.folder / "cgroup.procs").read_text().split():
                with contextlib.suppress(OSError):
                    (self._parent / "cgroup.procs").write_text(pid)
        with contextlib.suppress(OSError):
            self.folder.rmdir()


def groups() -> list[tuple[str, Path, int]]:
    """Where this process's control groups with a `cpu` controller lie: name, folder, version."""
    found: list[tuple[str, Path, int]] = []
    with contextlib.suppress(OSError, ValueError):
        mine = [line.split(":", 2) for line in Path("/proc/self/cgroup").read_text().splitlines()]
        for mount in Path("/proc/self/mounts").read_text().splitlines():
            _, place, kind, options, *_ = mount.split()
            for _, controllers, path in mine:
                if kind == "cgroup2" and not controllers:
                    found.append((CGROUP2, Path(place + path), 2))
                elif kind == "cgroup" and "cpu" in options.split(",") and (
                    "cpu" in controllers.split(",")
                ):  # fmt: skip
                    found.append((CGROUP1, Path(place + path), 1))
    return sorted(found, key=lambda one: -one[2])


def usable_group() -> tuple[str, Path, int] | None:
    """The first of them in which this user may make a limited group; None: there is none."""
    for name, parent, version in groups():
        with contextlib.suppress(OSError), Group(parent, version) as group:
            group.limit(0.5)
            return name, parent, version
    return None


def method() -> str:
    """How `throttled` will do it here."""
    group = usable_group()
    return group[0] if group else STOPPING


def tree(pid: int, spared: Collection[int] = ()) -> set[int]:
    """A process and its descendants now, without the spared ones and theirs (proc(5), stat)."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, IndexError, ValueError):
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
    found: set[int] = set()
    wave = {pid} & parents.keys()
    while wave:
        found |= wave
        wave = {one for one, of in parents.items() if of in wave} - found - set(spared)
    return found


@contextlib.contextmanager
def throttled(pid: int, cores: float, spared: Collection[int] = ()) -> Iterator[str]:
    """Leaves a process and its descendants, those that come later too, this much of the processor.

    Together they have up to 1 core meanwhile; `spared` ones, and what those have started, are left
    alone. Gives the method. By stopping, they are held to one core and run for the share `cores` of
    each 20 ms.
    """
    if not 0.0 < cores <= 1.0:
        raise ValueError(f"cores: {cores:g} is not in (0, 1]")
    group = usable_group()
    if group is None:
        with stopped_in_turn(pid, cores, spared):
            yield STOPPING
        return
    name, parent, version = group
    with Group(parent, version) as one:
        one.limit(cores)
        taken: set[int] = set()
        while found := tree(pid, spared) - taken:  # one may start another before it is taken
            for member in found:
                with contextlib.suppress(ProcessLookupError):  # it has just ended
                    one.take(member)
            taken |= found
        yield name


@contextlib.contextmanager
def stopped_in_turn(pid: int, cores: float, spared: Collection[int] = ()) -> Iterator[None]:
    """Holds a process and its descendants to one core and stops them for the rest of each turn."""
    core = min(os.sched_getaffinity(0))
    for member in tree(pid, spared):
        with contextlib.suppress(OSError):  # it has just ended, or one of its threads
            for task in Path(f"/proc/{member}/task").iterdir():
                os.sched_setaffinity(int(task.name), {core})
    closing = threading.Event()

    def turn() -> None:
        while not closing.wait(cores * TURN_S):
            held = tree(pid, spared)
            _send(signal.SIGSTOP, held)
            closing.wait((1.0 - cores) * TURN_S)
            _send(signal.SIGCONT, held)

    thread = threading.Thread(target=turn, name="throttle", daemon=True)
    if cores < 1.0:
        thread.start()
    try:
        yield
    finally:
        closing.set()
        if thread.is_alive():
            thread.join()


def _send(number: signal.Signals, pids: Collection[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
