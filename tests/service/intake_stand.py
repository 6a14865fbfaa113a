"""The intake as its process, a bus to hear it on, and payloads that fly to it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "stream"), str(TESTS / "faults")]
# It has folders of the packages' names, without an __init__: these come first where they are found.
sys.path += [str(TESTS.parent), str(TESTS)]

from impaired_link import ImpairedLink, Impairment  # noqa: E402
from numbered_flight import (  # noqa: E402
    GOP,
    capture_ns,
    encoded,
    number_in,
    packets,
    stamped,
    write_flight,
)
from payload_process import PayloadProcess, free_port  # noqa: E402
from waiting import eventually  # noqa: E402

from ground_station.service import bus_messages  # noqa: E402
from ground_station.service.bus import Bus, Router  # noqa: E402
from ground_station.service.bus_messages import (  # noqa: E402
    EventMessage,
    FrameMessage,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.pictures import PictureReader  # noqa: E402
from ground_station.service.settings import Run, StationSettings, write_run  # noqa: E402
from pi_firmware.wire.config import from_mapping  # noqa: E402

__all__ = [
    "CAMERA", "GOP", "ROUND", "ImpairedLink", "Impairment", "Stand", "capture_ns", "encoded",
    "eventually", "free_udp_port", "number_in", "packets", "stamped",
]  # fmt: skip

ROUND = 60
"""Frames of the flight that is flown in a loop, each with its number in its picture."""
CAMERA = """width_px = 640
height_px = 480
fx_px = 501.58
fy_px = 505.57
cx_px = 312.51
cy_px = 241.21
k1 = 0.1673
"""


def free_udp_port() -> int:
    """A port on which nobody listens now."""
    return free_port(socket.SOCK_DGRAM)


def flight(folder: Path) -> Path:
    """The numbered flight as a recording."""
    path = folder / "numbered.mcap"
    return path if path.exists() else write_flight(path, ROUND)


class Heard:
    """All notes that were said, and the number that each frame's picture shows."""

    def __init__(self, bus: Bus, folder: Path) -> None:
        self.frames: list[tuple[str, FrameMessage, int]] = []
        """With the picture's number, -1 where the picture had gone."""
        self.payloads: dict[str, list[PayloadMessage]] = {}
        self.events: list[tuple[str, EventMessage]] = []
        self.recording: list[RecordingMessage] = []
        self.latency_ms: list[float] = []
        """From the last packet of a frame to its note's being here."""
        self._folder = folder
        self._readers: dict[str, PictureReader] = {}
        self._lock = threading.Lock()
        bus.subscribe(bus_messages.FRAME, FrameMessage, self._frame)
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self._payload)
        bus.subscribe(
            bus_messages.EVENT, EventMessage, lambda who, note: self.events.append((who, note))
        )
        bus.subscribe(
            bus_messages.RECORDING, RecordingMessage, lambda _, note: self.recording.append(note)
        )

    def _frame(self, payload_id: str, note: FrameMessage) -> None:
        self.latency_ms.append((time.time_ns() - note.arrival_ns) / 1e6)
        reader = self._readers.setdefault(payload_id, PictureReader(self._folder, payload_id))
        image = reader.read(note.slot, note.stamp)
        self.frames.append((payload_id, note, -1 if image is None else number_in(image)))

    def _payload(self, payload_id: str, note: PayloadMessage) -> None:
        with self._lock:
            self.payloads.setdefault(payload_id, []).append(note)

    def payload(self, payload_id: str) -> PayloadMessage | None:
        """The newest note of one payload."""
        with self._lock:
            said = self.payloads.get(payload_id)
            return said[-1] if said else None

    def of(self, payload_id: str) -> list[tuple[FrameMessage, int]]:
        """One payload's frames so far."""
        return [(note, number) for who, note, number in list(self.frames) if who == payload_id]

    def more(self, count: int, *payload_ids: str) -> None:
        """Waits until more than so many further frames of each have come."""
        seen = {name: len(self.of(name)) for name in payload_ids}
        eventually(lambda: all(len(self.of(name)) > seen[name] + count for name in seen))

    def event_names(self, payload_id: str) -> list[str]:
        """The names of one payload's events so far."""
        return [note.name for who, note in list(self.events) if who == payload_id]


class Stand:
    """A run of the intake, unless not `served`; a context manager that ends what it started."""

    def __init__(self, folder: Path, *, served: bool = True, **tables: dict[str, Any]) -> None:
        self.folder = folder
        self.run_folder = folder / "run"
        self.run_folder.mkdir()
        (folder / "camera.toml").write_text(CAMERA)
        self.port = free_udp_port()
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.recordings = folder / "recordings"
        document: dict[str, Any] = {
            "map": {"camera": str(folder / "camera.toml")},
            "video": {"port": self.port},
            "telemetry": {"listen": [self.endpoint]},
            "recording": {"folder": str(self.recordings), "min_free_MB": 0},
        }
        for name, table in tables.items():
            document[name] = {**document.get(name, {}), **table}
        self.settings = from_mapping(document, StationSettings)
        write_run(self.run_folder, Run(self.settings))
        self.recording = flight(folder)
        self._stack = contextlib.ExitStack()
        self._served, self._count = served, 0

    def __enter__(self) -> Stand:
        router = Router(self.run_folder)
        self._stack.callback(router.close)
        self.bus = self._stack.enter_context(Bus(self.run_folder, "test"))
        self.heard = Heard(self.bus, self.run_folder)
        if self._served:
            self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def start(self) -> None:
        """Starts the intake, and waits until it says how its recording is."""
        before = len(self.heard.recording)
        err = (self.folder / "intake.txt").open("a")
        with err:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ground_station.service.intake", str(self.run_folder)],
                stdin=subprocess.DEVNULL,
                stderr=err,
            )
        process = self.process
        self._stack.callback(lambda: (process.kill(), process.wait()))
        eventually(lambda: len(self.heard.recording) > before or process.poll() is not None)
        assert process.poll() is None, self.written()

    def written(self) -> str:
        """What the intake wrote on standard error."""
        return (self.folder / "intake.txt").read_text()

    def payload(
        self, payload_id: str, *settings: str, port: int = 0, query: str = ""
    ) -> PayloadProcess:
        """Starts a payload that flies the numbered flight again and again."""
        self._count += 1
        return self._stack.enter_context(
            PayloadProcess(
                self.folder / f"payload-{self._count}",
                f"payload_id={payload_id}",
                f"camera.uri=replay:{self.recording}?loop=1{query}",
                "gate.enabled=false",
                f"link.port={port or self.port}",
                f"telemetry.connect={json.dumps([self.endpoint])}",
                *settings,
            )
        )

    def ask(self, **request: Any) -> dict[str, Any]:
        """A question to the intake."""
        return dict(self.bus.query("intake", request, timeout_s=30.0))

    def settled(self, payload_id: str, ended: dict[str, int]) -> PayloadMessage:
        """The payload's note once it tells of all frames that the payload says it sent."""

        def told() -> PayloadMessage | None:
            note = self.heard.payload(payload_id)
            said = note.frames if note is not None else {}
            fits = all(said.get(name) == value for name, value in ended.items())
            return note if fits and note is not None and not note.alive else None

        try:
            return eventually(told)
        except AssertionError:
            note = self.heard.payload(payload_id)
            raise AssertionError(f"{ended} {note and dataclasses.asdict(note)}") from None
