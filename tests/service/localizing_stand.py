"""What stands around a localizer process in its tests: a bus, an intake that only passes on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tomli_w
from receiving import Receiver

from ground_station.service import bus_messages, settings
from ground_station.service.bus import Bus, Router
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    ProcessMessage,
)
from ground_station.service.pictures import PictureWriter
from ground_station.service.settings import Run
from ground_station.stream.assembly import ReceivedFrame
from pi_firmware.wire.config import from_mapping

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "maps" / "atrium"
PAYLOAD = "blimp-1"
NAME = f"localizer/{PAYLOAD}"
LIMIT_S = 120.0


class Station:
    """The bus with everything that a localizer says kept, and an intake's voice."""

    def __init__(self, run_folder: Path, **map_settings: str) -> None:
        self.folder = run_folder
        chosen = {"folder": str(SAMPLE), "shelf": str(SAMPLE.parent), **map_settings}
        run = from_mapping({"station": {"map": chosen}}, Run, where="test")
        settings.write_run(run_folder, run)
        self.run = run
        self.router = Router(run_folder)
        self.bus = Bus(run_folder, "station")
        self.estimates: list[EstimateMessage] = []
        self.events: list[EventMessage] = []
        self.beats: list[ProcessMessage] = []
        self.said, self.ssrc = 0, 1
        self.pictures = PictureWriter(run_folder, PAYLOAD)
        self.bus.subscribe(
            bus_messages.ESTIMATE, EstimateMessage, lambda _, note: self.estimates.append(note)
        )
        self.bus.subscribe(
            bus_messages.EVENT, EventMessage, lambda _, note: self.events.append(note)
        )
        self.bus.subscribe(bus_messages.PROCESS, ProcessMessage, self._beat)

    def _beat(self, _: str, note: ProcessMessage) -> None:
        if note.name == NAME:
            self.beats.append(note)

    def anew(self) -> None:
        """Another session of the payload begins, of which nothing was said yet."""
        self.said, self.ssrc = 0, self.ssrc + 1
        self.estimates.clear()
        self.events.clear()

    def close(self) -> None:
        self.bus.close()
        self.router.close()

    def event(self, name: str) -> EventMessage | None:
        return next((event for event in list(self.events) if event.name == name), None)

    def say(self, note: FrameMessage) -> FrameMessage:
        self.said += 1
        self.bus.publish(bus_messages.FRAME, PAYLOAD, note)
        return note

    def show(self, image: Any, sequence: int, time_ns: int, /, **fields: Any) -> FrameMessage:
        """A frame as an intake tells it."""
        slot, stamp = self.pictures.write(image)
        ssrc = fields.get("ssrc", self.ssrc)
        if isinstance(ssrc, int) and ssrc != self.ssrc:
            self.ssrc, self.said = ssrc, 0
        now_ns = time.time_ns()
        values: dict[str, Any] = {
            "slot": slot,
            "stamp": stamp,
            "sequence": sequence,
            "time_ns": time_ns,
            "clock_ns": now_ns,
            "capture_ns": now_ns,
            "arrival_ns": now_ns,
            "width_px": image.shape[1],
            "height_px": image.shape[0],
            "ssrc": self.ssrc,
            "shown": self.said + 1,
        }
        return self.say(FrameMessage(**(values | fields)))

    def pass_on(self, frame: ReceivedFrame) -> FrameMessage:
        """A received frame; payload and station share a clock here."""
        return self.show(
            frame.image,
            frame.sequence,
            frame.time_ns,
            clock_ns=frame.clock_ns,
            capture_ns=frame.clock_ns,
            arrival_ns=frame.arrival_ns,
            exposure_s=frame.exposure_s,
            gain=frame.gain,
            entropy_bits=frame.entropy_bits,
            sharpness=frame.sharpness,
            heartbeat=frame.heartbeat,
            ssrc=frame.ssrc,
        )

    def accounted(self) -> bool:
        """Whether the newest estimate accounts for every frame that was told of."""
        newest = self.estimates[-1] if self.estimates else None
        return newest is not None and newest.processed + newest.skipped == self.said


@contextmanager
def station(run_folder: Path, **map_settings: str) -> Iterator[Station]:
    made = Station(run_folder, **map_settings)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def localizer(folder: Path, payload_id: str = PAYLOAD) -> Iterator[subprocess.Popen[str]]:
    """The process, as the service starts it."""
    command = [sys.executable, "-m", "ground_station.service.localizing", str(folder), payload_id]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        process.communicate()


class Intake:
    """Passes on what a receiver gets, on a thread, until it is closed."""

    def __init__(self, to: Station) -> None:
        self._station = to
        self.receiver = Receiver(port=0, queue_frames=64)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake")
        self._thread.start()

    def __enter__(self) -> Intake:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self.receiver.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            frame = self.receiver.get(0.1)
            if frame is not None:
                self._station.pass_on(frame)


def payload(
    port: int, *, start_s: float = 2.0, duration_s: float = 4.0, rate_hz: float = 30.0
) -> dict[str, Any]:
    """The configuration of a payload that plays a stretch of the sample's flight."""
    options = f"rate_hz={rate_hz:g}&start_s={start_s:g}&duration_s={duration_s:g}"
    return {
        "payload_id": PAYLOAD,
        "camera": {
            "uri": f"replay:{SAMPLE / 'flight.mcap'}?{options}",
            "width_px": 640,
            "height_px": 480,
        },
        "encoder": {"bitrate_kbps": 2000, "adapt": False},
        "link": {"port": port},
        "telemetry": {"connect": ["tcp/127.0.0.1:1"]},  # nobody listens there
        "supervision": {"frame_timeout_s": 14.0},
        "wifi": {"interface": ""},
    }


def copy_map(folder: Path, **changes: Any) -> Path:
    """The sample's map in another folder, with keys of its map.toml changed, as frame="sfm"."""
    folder.mkdir(parents=True)
    for name in ("landmarks.safetensors", "keyframes.safetensors"):
        shutil.copy(SAMPLE / name, folder)
    document = tomllib.loads((SAMPLE / "map.toml").read_text())
    for key, value in {"name": folder.name, **changes}.items():
        *tables, last = key.split(".")
        inner = document
        for part in tables:
            inner = inner[part]
        inner[last] = value
    (folder / "map.toml").write_text(tomli_w.dumps(document))
    return folder
