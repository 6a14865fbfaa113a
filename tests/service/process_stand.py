"""What stands around a process of the service in its tests: its run, its bus, its start and end."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import station_notes as notes

from ground_station.service import bus_messages, settings
from ground_station.service.bus import Bus, Router
from ground_station.service.bus_messages import EventMessage, FrameMessage, Message, ProcessMessage
from ground_station.service.pictures import PictureWriter
from ground_station.service.settings import Run
from pi_firmware.wire.config import from_mapping

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "maps" / "atrium"


@contextlib.contextmanager
def program(module: str, *words: str, **streams: Any) -> Iterator[subprocess.Popen[str]]:
    """A process of the service, as it starts it; killed at the end if it still runs."""
    command = [sys.executable, "-m", f"ground_station.service.{module}", *words]
    process = subprocess.Popen(command, text=True, **streams)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class Station:
    """A run in the sample's map with its bus, what processes say on it, and a payload's pictures.

    A context manager; `tables` are of `station.toml`.
    """

    def __init__(self, folder: Path, **tables: Any) -> None:
        self.folder = folder
        chosen = {"folder": str(SAMPLE), "shelf": str(SAMPLE.parent)} | tables.pop("map", {})
        self.run = from_mapping({"station": {"map": chosen, **tables}}, Run, where="test")
        settings.write_run(folder, self.run)
        self.pictures = PictureWriter(folder, notes.PAYLOAD)
        self.open()

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        """Begins a bus."""
        self.beats: list[ProcessMessage] = []
        self.events: list[EventMessage] = []
        self.router = Router(self.folder)
        self.bus = Bus(self.folder, "station")
        self.bus.subscribe(
            bus_messages.PROCESS, ProcessMessage, lambda _, note: self.beats.append(note)
        )
        self.bus.subscribe(
            bus_messages.EVENT, EventMessage, lambda _, note: self.events.append(note)
        )

    def close(self) -> None:
        """Ends it."""
        self.bus.close()
        self.router.close()

    def say(self, note: Message, payload_id: str = notes.PAYLOAD) -> None:
        """Says a frame or an estimate of a payload."""
        kind = bus_messages.FRAME if isinstance(note, FrameMessage) else bus_messages.ESTIMATE
        self.bus.publish(kind, payload_id, note)

    def show(self, image: Any, sequence: int, **fields: Any) -> FrameMessage:
        """A frame as an intake tells it; the picture is the payload's."""
        slot, stamp = self.pictures.write(image)
        height, width = image.shape
        known = {"slot": slot, "stamp": stamp, "width_px": width, "height_px": height}
        note = notes.frame(**{**known, "sequence": sequence, **fields})
        self.say(note)
        return note
