"""What stands around a localizer process in its tests: a bus, an intake that only passes on."""

from __future__ import annotations

import shutil
import subprocess
import threading
import tomllib
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import process_stand as stand
import tomli_w
from process_stand import SAMPLE, program
from receiving import Receiver
from station_notes import PAYLOAD

from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    Message,
)
from ground_station.stream.assembly import ReceivedFrame

NAME = f"localizer/{PAYLOAD}"
LIMIT_S = 120.0


class Station(stand.Station):
    """The bus with everything that a localizer says kept, and an intake's voice."""

    def __init__(self, run_folder: Path, **map_settings: str) -> None:
        self.estimates: list[EstimateMessage] = []
        self.said, self.ssrc = 0, 1
        super().__init__(run_folder, map=map_settings)
        self.bus.subscribe(
            bus_messages.ESTIMATE, EstimateMessage, lambda _, note: self.estimates.append(note)
        )

    def anew(self) -> None:
        """Another session of the payload begins, of which nothing was said yet."""
        self.said, self.ssrc = 0, self.ssrc + 1
        self.estimates.clear()
        self.events.clear()

    def event(self, name: str) -> EventMessage | None:
        return next((event for event in list(self.events) if event.name == name), None)

    def say(self, note: Message, payload_id: str = PAYLOAD) -> None:
        self.said += 1
        super().say(note, payload_id)

    def show(self, image: Any, sequence: int, time_ns: int, /, **fields: Any) -> FrameMessage:
        ssrc = fields.get("ssrc", self.ssrc)
        if isinstance(ssrc, int) and ssrc != self.ssrc:
            self.ssrc, self.said = ssrc, 0
        fields = {"time_ns": time_ns, "ssrc": self.ssrc, "shown": self.said + 1} | fields
        return super().show(image, sequence, **fields)

    def pass_on(self, frame: ReceivedFrame) -> FrameMessage:
        """A received frame; payload and station share a clock here."""
        told = vars(frame.info) | {"capture_ns": frame.clock_ns, "arrival_ns": frame.arrival_ns}
        sequence, time_ns = told.pop("sequence"), told.pop("time_ns")
        return self.show(frame.image, sequence, time_ns, **told, ssrc=frame.ssrc)

    def accounted(self) -> bool:
        """Whether the newest estimate accounts for every frame that was told of."""
        newest = self.estimates[-1] if self.estimates else None
        return newest is not None and newest.processed + newest.skipped == self.said


def localizer(folder: Path) -> AbstractContextManager[subprocess.Popen[str]]:
    """The process, as the service starts it."""
    return program("localizing", str(folder), PAYLOAD, stderr=subprocess.PIPE)


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
