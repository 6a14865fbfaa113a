"""The ground station of one flight: the service's own intake and localizer, on a bus of their own.

Nothing of theirs stands here a second time: what a replay measures is what `blimp serve` runs.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from ground_station.errors import GroundStationError, MapError
from ground_station.replay.resources import Side, Watch
from ground_station.service import bus_messages, processes
from ground_station.service.bus import Bus, Router
from ground_station.service.bus_messages import EventMessage, ProcessMessage
from ground_station.service.processes import Children
from ground_station.service.serve import run_folder
from ground_station.service.settings import Run, write_run

_READY_S = 120.0
"""To import, to open ports and to load a large map, on a busy machine."""
_POLL_S = 0.05


class StationError(GroundStationError):
    """The ground station of a flight does not start; its processes have said why."""


class Station:
    """One run's processes; `step` them several times a second. Made by `station`."""

    def __init__(self, folder: Path, run: Run, payload_id: str, bus: Bus) -> None:
        self.folder, self.bus = folder, bus
        self.video_port = 0
        self.endpoints: tuple[str, ...] = ()
        """Where the payload's video and telemetry are to go, once it is `ready`."""
        self._payload_id = payload_id
        self._events: list[EventMessage] = []
        self._watches: list[Watch] = []
        bus.subscribe(
            bus_messages.PROCESS,
            ProcessMessage,
            lambda _, message: self.children.heartbeat(message.name, message.pid),
        )
        bus.subscribe(
            bus_messages.EVENT, EventMessage, lambda _, message: self._events.append(message)
        )
        specs = (processes.intake(folder), processes.localizer(folder, payload_id))
        self.children = Children(specs, lambda said: print(f"replay: {said}", file=sys.stderr))

    def ready(self) -> None:
        """Waits until ports are open and the map is loaded; raises a `BlimpError` when not."""
        until_s = time.monotonic() + _READY_S
        while True:
            self.step()
            for event in self._events:
                if event.name == "map-refused":
                    raise MapError(event.text)
            if any(event.name == "map-loaded" for event in self._events):
                break
            if time.monotonic() > until_s:
                raise StationError(f"the ground station was not ready within {_READY_S:g} s")
            time.sleep(_POLL_S)
        # The other process may be the later one.
        while not (answer := self.bus.query("intake", {"do": "endpoints"}))["done"]:
            if time.monotonic() > until_s:
                raise StationError(str(answer["reason"]))
            self.step()
            time.sleep(_POLL_S)
        self.video_port, self.endpoints = answer["video_port"], tuple(answer["telemetry"])
        self._watches = [Watch(pid) for pid in self.children.pids().values()]
        for watch in self._watches:
            watch.__enter__()

    def step(self) -> None:
        """Looks after the processes; raises a `BlimpError` when one cannot start."""
        self.children.step()

    def side(self) -> Side:
        """What its processes took since they were ready, all together."""
        sides = [watch.side() for watch in self._watches]
        memory = [side.memory_MB for side in sides if side.memory_MB is not None]
        cpu = [side.cpu for side in sides if side.cpu is not None]
        return Side(sum(memory) if memory else None, sum(cpu) if cpu else None, "/proc")

    def close(self) -> None:
        """Ends all."""
        for watch in self._watches:
            watch.__exit__()
        self.children.close()


@contextlib.contextmanager
def station(run: Run, payload_id: str) -> Iterator[Station]:
    """A ground station that is ready for one payload; raises a `BlimpError` with one line."""
    with run_folder() as folder:
        write_run(folder, run)
        router = Router(folder)
        try:
            with Bus(folder, "replay", lossless=run.stepped) as bus:
                made = Station(folder, run, payload_id, bus)
                try:
                    made.ready()
                    yield made
                finally:
                    made.close()
        finally:
            router.close()
