"""What befalls the ground station: its processes, its clock, its disk."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from intake_stand import eventually
from standing import is_stopped

from scenarios import disk
from scenarios.payload_steps import PayloadClock
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World

_GONE_S = 2.0


@dataclass(frozen=True)
class Killed(Step):
    """A signal for one of the service's processes, which its parent restarts.

    SIGKILL is what it gets when memory ends, SIGSEGV when its decoder does what it must not.
    """

    process: str = "intake"
    signal: str = "SIGKILL"
    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        found = world.child(self.process)
        world.kept[id(self)] = found
        if found is None:
            return
        if self.process == "intake":
            world.end_recording("ground")
            world.intake_anew_s.append(time.monotonic())
        with contextlib.suppress(ProcessLookupError):
            os.kill(found.pid, signal.Signals[self.signal])

    def lacking(self, world: World) -> str:
        found = world.kept[id(self)]
        if found is None:
            return f"no {self.process} to kill"
        with contextlib.suppress(AssertionError):
            eventually(lambda: not found.living, _GONE_S)
        return "it lives" if found.living else ""


@dataclass(frozen=True)
class Stopped(Step):
    """SIGSTOP for one of them, `station` being the parent with the bus; SIGCONT."""

    process: str = "localizer"
    STARTS: ClassVar[bool] = True  # one that is silent for 10 s is ended by its parent

    def inject(self, world: World) -> None:
        found = world.kept[id(self)] = world.child(self.process)
        if found is not None:
            os.kill(found.pid, signal.SIGSTOP)

    def lacking(self, world: World) -> str:
        found = world.kept[id(self)]
        if found is None:
            return f"no {self.process} to stop"
        return "" if is_stopped(found.pid) or not found.living else "it runs"

    def fix(self, world: World) -> None:
        found = world.kept.pop(id(self))
        if found is not None and found.living:
            os.kill(found.pid, signal.SIGCONT)


@dataclass(frozen=True)
class Asleep(Step):
    """The laptop sleeps: nothing of the service runs; with `GroundClock` it wakes an hour later."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        names = ("station", "intake", "web", "localizer")
        found = [one for name in names if (one := world.child(name)) is not None]
        world.kept[id(self)] = found
        for one in found:
            os.kill(one.pid, signal.SIGSTOP)

    def lacking(self, world: World) -> str:
        found = world.kept[id(self)]
        awake = [one.name for one in found if not is_stopped(one.pid)]
        return f"awake: {awake}" if awake or not found else ""

    def fix(self, world: World) -> None:
        for one in reversed(world.kept.pop(id(self))):
            if one.living:
                os.kill(one.pid, signal.SIGCONT)


@dataclass(frozen=True)
class ServiceKilled(Step):
    """SIGKILL for the whole service; its user starts it again."""

    STARTS: ClassVar[bool] = True

    def inject(self, world: World) -> None:
        world.hold_service(self)

    def lacking(self, world: World) -> str:
        return "it serves" if world.service.process.poll() is None else ""

    def fix(self, world: World) -> None:
        world.let_service(self)


@dataclass(frozen=True)
class ServiceRestarted(ServiceKilled):
    """The same in order, as for an update."""

    def inject(self, world: World) -> None:
        world.hold_service(self, kill=False)


@dataclass(frozen=True)
class GroundClock(PayloadClock):
    """The same of the ground station."""

    SIDE: ClassVar[str] = "ground"


@dataclass(frozen=True)
class DiskFault(Step):
    """The disk of the ground's recordings fails: one of `disk.KINDS`; then it takes more again.

    One that stalls ends no recording.
    """

    kind: str = "full"

    def inject(self, world: World) -> None:
        found, befell = None, world.befell("ground")
        if self.kind in disk.ERRORS:
            world.disturb(self, "ground", "file_fault", disk.ERRORS[self.kind])
        elif world.disk is not None:
            world.disk.fill()
        elif found := world.child("intake"):
            disk.limit_files(found.pid, disk.size_now(world.service.recordings))
        window = world.end_recording("ground") if self.kind != disk.STALLS else [0.0, 0.0]
        world.kept[id(self)] = (found, window, befell)

    def lacking(self, world: World) -> str:
        if self.kind in disk.ERRORS and world.befell("ground") == world.kept[id(self)][2]:
            return "it wrote nothing"
        if self.kind == disk.STALLS:
            return "" if world.recording() else "it does not record any more"
        return "it records" if world.recording() else ""

    def fix(self, world: World) -> None:
        found, window, _ = world.kept.pop(id(self))
        world.disturb(self, "ground", "file_fault", 0)
        if world.disk is not None:
            world.disk.free()
        elif found is not None and found.living:
            disk.limit_files(found.pid, None)
        world.record()
        window[1] = time.monotonic()


@dataclass(frozen=True)
class FolderTaken(Step):
    """The folder of recordings is moved away, and in its place is a file; what records ends."""

    def inject(self, world: World) -> None:
        folder = world.service.recordings
        away = folder.with_name("away")
        if folder.is_dir() and not away.exists():
            world.kept[id(self)] = (away, world.end_recording("ground"))
            folder.rename(away)
            folder.write_text("no folder")
        with contextlib.suppress(Exception):  # a web process may be down at this moment
            world.service.client.post("/api/recording", json={"active": False})
            world.service.client.post("/api/recording", json={"active": True})

    def lacking(self, world: World) -> str:
        return "it records" if id(self) not in world.kept or world.recording() else ""

    def fix(self, world: World) -> None:
        if kept := world.kept.pop(id(self), None):
            away, window = kept
            world.service.recordings.unlink()
            away.rename(world.service.recordings)
            world.record()
            window[1] = time.monotonic()
