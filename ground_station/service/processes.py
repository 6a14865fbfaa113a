"""The service's processes: one table, started, watched and started again.

Each says on the bus that it lives (`Bus.heartbeat`). One that ends or falls silent is restarted,
after a pause that doubles; nobody else waits for it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ground_station.errors import GroundStationError

INTAKE, LOCALIZER, WEB, FOXGLOVE, PAYLOAD = "intake", "localizer", "web", "foxglove", "demo-payload"
BAD_INPUT = 2
_SILENT_S = 10.0
_SLEPT_S = 2.0  # between two steps of a loop that takes a tenth of a second
_START_S = 60.0  # the first beat of a process that loads a large map on a busy machine
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 10.0
_STEADY_S = 30.0  # who has lived this long begins with the shortest pause again
_TERM_S = 8.0
_KILL_S = 1.0  # one in the kernel's hands may not end for ever


class ServiceError(GroundStationError):
    """A service that cannot start, or must end."""


@dataclass(frozen=True)
class Spec:
    """A process: its name, `python -m` module and arguments.

    `needed`: bad input at its start ends the service, with its own line on standard error. `beats`:
    it says that it lives. `later`: its first start waits for all needed ones, which then have the
    processors for themselves.
    """

    name: str
    module: str
    arguments: tuple[str, ...] = ()
    needed: bool = True
    beats: bool = True
    later: bool = False


class Child:
    """One process of the table, from start to start."""

    def __init__(self, spec: Spec, clock: Callable[[], float] = time.monotonic) -> None:
        self.spec = spec
        self.restarts = 0
        self._clock = clock
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0
        self._heard_s: float | None = None
        self._last_heard_s = clock()
        self._due_s: float | None = clock()
        self.started = False
        """Whether it ever was."""
        self._pause_s = _FIRST_PAUSE_S

    @property
    def pid(self) -> int | None:
        """Its process id while it runs."""
        return self._process.pid if self._process else None

    @property
    def living(self) -> bool:
        """Whether it runs and, if it beats, was heard within 10 s."""
        if self._process is None:
            return False
        return not self.spec.beats or (
            self._heard_s is not None and self._clock() - self._heard_s < _SILENT_S
        )

    @property
    def hopeful(self) -> bool:
        """Whether it was heard within a minute: restarts of its own may still fix it."""
        return not self.spec.beats or self._clock() - self._last_heard_s < _START_S

    def heartbeat(self, pid: int) -> None:
        """It was heard; a beat of the process before it does not count."""
        if self._process is not None and pid == self._process.pid:
            self._heard_s = self._last_heard_s = self._clock()

    def step(self) -> str:
        """Starts it when it is due, and ends one that is silent; what happened, in words, or "".

        Raises `ServiceError` when a needed one refuses its input before its first beat.
        """
        now_s = self._clock()
        if self._process is None:
            if self._due_s is not None and now_s >= self._due_s:
                self._start()
            return ""
        status = self._process.poll()
        if status is not None:
            bad = status == BAD_INPUT and self._heard_s is None
            if bad and self.spec.needed:
                raise ServiceError(f"{self.spec.name} cannot start")
            return self._fell(f"ended with status {status}")
        since_s = now_s - (self._started_s if self._heard_s is None else self._heard_s)
        if self.spec.beats and since_s > (_START_S if self._heard_s is None else _SILENT_S):
            self._kill()
            return self._fell(f"was silent for {since_s:.0f} s")
        return ""

    def excuse(self, seconds: float) -> None:
        """Time in which nobody listened counts for nothing."""
        now_s = self._clock()
        self._started_s += seconds
        self._last_heard_s = min(now_s, self._last_heard_s + seconds)
        if self._heard_s is not None:
            self._heard_s = min(now_s, self._heard_s + seconds)

    def terminate(self) -> None:
        """Asks it to end."""
        self._due_s = None
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

    def wait(self, until_s: float) -> None:
        """Waits until it has ended, and ends it the hard way at an instant of the clock."""
        if self._process is None:
            return
        try:
            self._process.wait(max(0.0, until_s - self._clock()))
        except subprocess.TimeoutExpired:
            self._kill()
        self._process = None

    def is_gone(self, until_s: float) -> bool:
        """Whether it has ended; from an instant of the clock on it is killed."""
        if self._process is None or self._process.poll() is not None:
            return True
        if self._clock() >= until_s:
            self._process.kill()
        return False

    def _start(self) -> None:
        command = [sys.executable, "-m", self.spec.module, *self.spec.arguments]
        # A parent that is killed takes its children with it, whoever started it.
        if setpriv := shutil.which("setpriv"):
            command = [setpriv, "--pdeathsig", "KILL", "--", *command]
        # One that crashes writes where each of its threads was. As in `blimp`, threads are ours to
        # schedule and not BLAS's.
        environment = {"OPENBLAS_NUM_THREADS": "1", **os.environ, "PYTHONFAULTHANDLER": "1"}
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment)
        self._started_s, self._heard_s, self._due_s = self._clock(), None, None
        self.started = True

    def _fell(self, reason: str) -> str:
        now_s = self._clock()
        if now_s - self._started_s > _STEADY_S:
            self._pause_s = _FIRST_PAUSE_S
        self._process = None
        self._due_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self.restarts += 1
        return f"{self.spec.name} {reason}; it is restarted"

    def _kill(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_KILL_S)


class Children:
    """The table at work; `step` it from the thread that made it, `beat` it from any."""

    def __init__(
        self,
        specs: tuple[Spec, ...],
        report: Callable[[str], object],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._report, self._clock = report, clock
        self._lock = threading.Lock()
        self._children = {spec.name: Child(spec, clock) for spec in specs}
        self._stepped_s = clock()
        self._leaving: dict[str, tuple[Child, float]] = {}
        """What was removed and has not ended yet, with when it is killed."""

    def __contains__(self, name: str) -> bool:
        return name in self._children

    def add(self, spec: Spec) -> None:
        """Another process, unless one of its name is there or still ends."""
        if spec.name in self._leaving:
            return
        with self._lock:
            self._children.setdefault(spec.name, Child(spec, self._clock))

    def remove(self, name: str) -> None:
        """Lets a process end, which nobody waits for, and forgets it."""
        with self._lock:
            child = self._children.pop(name, None)
        if child is not None:
            child.terminate()
            self._leaving[name] = child, self._clock() + _TERM_S

    def heartbeat(self, name: str, pid: int) -> None:
        """A process was heard."""
        with self._lock:
            child = self._children.get(name)
        if child is not None:
            child.heartbeat(pid)

    def step(self) -> None:
        """Starts what is due; raises `ServiceError` when a needed process cannot start.

        After a sleep of the whole computer nobody was silent: this process did not listen.
        """
        now_s = self._clock()
        if (slept_s := now_s - self._stepped_s) > _SLEPT_S:
            for child in list(self._children.values()):
                child.excuse(slept_s)
        self._stepped_s = now_s
        self._leaving = {
            name: (child, until_s)
            for name, (child, until_s) in self._leaving.items()
            if not child.is_gone(until_s)
        }
        for child in list(self._children.values()):
            if child.spec.later and not (child.started or self.living()):
                continue
            if said := child.step():
                self._report(said)

    def pids(self) -> dict[str, int]:
        """The process ids of those that run."""
        running = {name: child.pid for name, child in list(self._children.items())}
        return {name: pid for name, pid in running.items() if pid is not None}

    def living(self) -> bool:
        """Whether every needed process runs and was heard of late."""
        return all(child.living for child in self._needed())

    def hopeful(self) -> bool:
        """Whether none of the needed processes has been silent for a minute, restarts and all."""
        return all(child.hopeful for child in self._needed())

    def _needed(self) -> list[Child]:
        return [child for child in list(self._children.values()) if child.spec.needed]

    def close(self) -> None:
        """Ends all, the last ones started first."""
        children = list(reversed(self._children.values()))
        children += [child for child, _ in self._leaving.values()]
        for child in children:
            child.terminate()
        until_s = self._clock() + _TERM_S
        for child in children:
            child.wait(until_s)


def table(folder: Path, *, foxglove: bool, demo: Path | None) -> tuple[Spec, ...]:
    """The processes from the start; localizers come with their payloads.

    `demo` is the configuration of the payload that is played.
    """
    run = str(folder)
    specs = [intake(folder), Spec(WEB, "ground_station.service.web", (run,))]
    if foxglove:
        module = "ground_station.service.foxglove"
        specs.append(Spec(FOXGLOVE, module, (run,), needed=False, later=True))
    if demo is not None:
        specs.append(Spec(PAYLOAD, "pi_firmware", ("--config", str(demo)), beats=False))
    return tuple(specs)


def intake(folder: Path) -> Spec:
    """The intake."""
    return Spec(INTAKE, "ground_station.service.intake", (str(folder),))


def localizer(folder: Path, payload_id: str) -> Spec:
    """The localizer of a payload."""
    arguments = (str(folder), payload_id)
    name = f"{LOCALIZER}/{payload_id}"
    return Spec(name, "ground_station.service.localizing", arguments, needed=False)
