"""What befalls the ground station: its processes, its clock, its disk."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from standing import is_stopped

from scenarios import disk
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World


@dataclass(frozen=True)
class Killed(Step):
    """SIGKILL for one of the service's processes, which its parent restarts."""

    process: str = "intake"
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
            os.kill(found.pid, signal.SIGKILL)

    def lacking(self, world: World) -> str:
        return "" if world.kept[id(self)] else f"no {self.process} to kill"


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
class GroundClock(Step):
    """The ground station's wall clock is set by so many seconds, and set right again."""

    by_s: float = 3600.0

    def inject(self, world: World) -> None:
        world.disturb(self, "ground_clock", int(1e9 * self.by_s))

    def lacking(self, world: World) -> str:
        return "" if "ground_clock" in world.shims else "no shim sets it"

    def fix(self, world: World) -> None:
        world.disturb(self, "ground_clock", 0)


@dataclass(frozen=True)
class DiskFull(Step):
    """The disk of the ground's recordings takes no more; then there is room, and it records."""

    def inject(self, world: World) -> None:
        found = None
        if world.disk is not None:
            world.disk.fill()
        elif found := world.child("intake"):
            disk.limit_files(found.pid, disk.size_now(world.service.recordings))
        world.kept[id(self)] = (found, world.end_recording("ground"))

    def lacking(self, world: World) -> str:
        return "it records" if world.recording() else ""

    def fix(self, world: World) -> None:
        found, window = world.kept.pop(id(self))
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
