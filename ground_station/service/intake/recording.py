"""Starts and stops the ground's recordings, and takes what belongs in them without waiting."""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from ground_station.geometry.camera import Camera
from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    Level,
    Message,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.intake.files import STATION_TOPIC, Estimated, GroundRun, JsonMessage
from ground_station.service.settings import RecordingSettings
from ground_station.stream.assembly import ReceivedFrame
from pi_firmware.wire import keys, messages
from pi_firmware.wire.recorder.recorder import Recorder

_FREE_PERIOD_S = 2.0


class GroundRecorder(Recorder):
    """Records all payloads; its methods never wait for the disk, save `start` and `stop`.

    `announce` gets events with their level; `force_idr` asks all payloads for an IDR.
    """

    def __init__(
        self,
        settings: RecordingSettings,
        announce: Callable[[str, Level, str], None],
        *,
        camera: Camera | None = None,
        force_idr: Callable[[], object] = lambda: None,
    ) -> None:
        super().__init__(
            settings, lambda name, text: announce(name, self._level(), text), force_idr=force_idr
        )
        self._sizes: dict[str, tuple[int, int]] = {}
        self._run_type = functools.partial(
            GroundRun, camera=camera, max_file_s=settings.max_file_s, sizes=self._sizes
        )
        self.run_type = self._run_type
        self.resumed = ""
        """From which recording that was cut the one of now goes on, in words."""
        self._refused = ""
        self._started_s = 0.0
        self._free_MB: float | None = None
        self._free = threading.Event()
        # A disk that hangs holds up this thread and nobody else.
        threading.Thread(target=self._watch_disk, name="disk", daemon=True).start()

    @property
    def problem(self) -> str:
        """Why there is no recording although there should be one, in words."""
        return "" if self.file else self._refused or super().problem

    def start(self, after: str = "") -> str:
        """As `Recorder.start`; `after` is STATION/FILE, which a flight was recorded in before."""
        if not self.file:
            self.run_type = functools.partial(self._run_type, after=after)
            self._started_s = time.monotonic()
            self.resumed = ""
        file = super().start()
        self._refused = ""
        return file

    def refuse(self, reason: str) -> None:
        """Says that none could begin by itself, until one begins."""
        self._refused = reason
        self._announce(messages.EVENT_RECORDING_ENDED, reason)

    def frame(self, payload_id: str, frame: ReceivedFrame, log_ns: int) -> None:
        """Records a frame as it came; `log_ns` is when it was captured, by this machine's clock.

        Not a damaged one: who decodes a recording cannot know what of it, and of those after it, is
        as it was sent.
        """
        active = self._run
        if active is None or frame.damaged is not None:
            return
        height, width = frame.image.shape[:2]
        self._sizes[payload_id] = (width, height)
        active.queue.unit(frame.info, frame.access_unit, payload_id, log_ns)

    def message(self, payload_id: str, kind: str, message: messages.Message) -> None:
        """Records a telemetry message as it was said."""
        active = self._run
        if active is None:
            return
        with contextlib.suppress(Exception):
            text = messages.encode(message)
            topic = "/" + keys.key(payload_id, kind)
            active.queue.put(JsonMessage(topic, message.SCHEMA, time.time_ns(), text), len(text))

    def estimate(self, payload_id: str, note: EstimateMessage) -> None:
        """Records a pose, or that there is none."""
        active = self._run
        if active is not None:
            log_ns = note.done_ns if note.capture_ns is None else note.capture_ns
            active.queue.put(Estimated(payload_id, note, log_ns))

    def note(self, kind: str, payload_id: str, note: Message) -> None:
        """Records what the service says: events, and how it sees its payloads."""
        active = self._run
        if active is not None:
            place = "" if payload_id == bus_messages.STATION else f"/{payload_id}"
            topic = f"{STATION_TOPIC}{place}/{kind}"
            text = bus_messages.encode(note)
            account = (payload_id, note.frames) if isinstance(note, PayloadMessage) else None
            said = JsonMessage(topic, f"blimp.station.{kind}", time.time_ns(), text, account)
            active.queue.put(said, len(text))

    def state(self) -> RecordingMessage:
        """How it goes."""
        file = self.file
        return RecordingMessage(
            active=bool(file),
            file=file,
            size_MB=round(self.size_MB, 3),
            duration_s=round(time.monotonic() - self._started_s, 1) if file else 0.0,
            dropped=self.dropped,
            free_MB=self._free_MB,
            problem=self.problem,
            resumed=self.resumed if file else "",
        )

    def close(self, limit_s: float | None = None) -> None:
        """Stops for good."""
        self._free.set()
        super().close(limit_s)

    def _level(self) -> Level:
        return bus_messages.ALARM if self.problem else bus_messages.INFO

    def _watch_disk(self) -> None:
        folder = Path(self._settings.folder).absolute()
        while True:
            free_MB = None
            for place in (folder, folder.parent):  # it is made with the first recording
                with contextlib.suppress(OSError):
                    disk = os.statvfs(place)
                    free_MB = round(disk.f_bavail * disk.f_frsize / 1e6, 1)
                    break
            self._free_MB = free_MB
            if self._free.wait(_FREE_PERIOD_S):
                return
