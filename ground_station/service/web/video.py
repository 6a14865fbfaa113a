"""Pictures for viewers: each frame is encoded once for all of them, on a thread of its own."""

from __future__ import annotations

import json
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from ground_station.service.bus_messages import FrameMessage
from ground_station.service.pictures import PictureReader

_LENGTH = struct.Struct(">I")
_POLL_S = 0.5
_EARLY = 0.25
"""A frame may come this share of a period early: cameras and networks are not regular."""

Take = Callable[[str, bytes], None]


def message(payload_id: str, note: FrameMessage, jpeg: bytes) -> bytes:
    """A video message: the header's length (4 bytes, big-endian), the header in JSON, the JPEG."""
    header = {
        "type": "video",
        "payload": payload_id,
        "sequence": note.sequence,
        "capture_ns": note.capture_ns,
        "width_px": note.width_px,
        "height_px": note.height_px,
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    return _LENGTH.pack(len(text)) + text + jpeg


class Video:
    """Encodes the newest frame of each wanted payload, at most `rate_hz` times a second.

    `take` gets each message on this thread. `encoded`, `skipped` (too many for the rate or for this
    machine) and `gone` (the ring was overwritten) count the wanted frames.
    """

    def __init__(self, folder: Path, rate_hz: float, quality: int, take: Take) -> None:
        self._folder, self._period_s, self._quality = folder, 1.0 / rate_hz, quality
        self._take = take
        self.encoded = self.skipped = self.gone = self.failed = 0
        self._there = threading.Condition()
        self._wanted: frozenset[str] = frozenset()
        self._newest: dict[str, FrameMessage] = {}
        self._due_s: dict[str, float] = {}
        self._readers: dict[str, PictureReader] = {}
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="video", daemon=True)
        self._thread.start()

    def want(self, payload_ids: frozenset[str]) -> None:
        """Whose pictures are looked at."""
        with self._there:
            self._wanted = payload_ids

    def frame(self, payload_id: str, note: FrameMessage) -> None:
        """A frame was received; returns at once."""
        if payload_id not in self._wanted:
            return
        now_s = time.monotonic()
        with self._there:
            due_s = self._due_s.get(payload_id, 0.0)
            if now_s < due_s - _EARLY * self._period_s:
                self.skipped += 1
                return
            self._due_s[payload_id] = max(due_s, now_s - self._period_s) + self._period_s
            self.skipped += payload_id in self._newest
            self._newest[payload_id] = note
            self._there.notify()

    def close(self) -> None:
        """Ends the thread."""
        with self._there:
            self._closing = True
            self._there.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._there:
                self._there.wait_for(lambda: self._newest or self._closing, _POLL_S)
                if self._closing:
                    break
                newest, self._newest = self._newest, {}
                wanted = self._wanted
                self._due_s = {name: due for name, due in self._due_s.items() if name in wanted}
            for payload_id, note in newest.items():
                if payload_id in wanted:
                    self._encode(payload_id, note)
            for name in self._readers.keys() - wanted:
                self._readers.pop(name).close()
        for reader in self._readers.values():
            reader.close()

    def _encode(self, payload_id: str, note: FrameMessage) -> None:
        import cv2

        try:
            reader = self._readers.get(payload_id)
            if reader is None:
                reader = self._readers[payload_id] = PictureReader(self._folder, payload_id)
            image = reader.read(note.slot, note.stamp)
            if image is None:
                self.gone += 1
                return
            done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
            if done:
                self._take(payload_id, message(payload_id, note, jpeg.tobytes()))
                self.encoded += 1
        except Exception:  # a picture that cannot be encoded ends nothing
            self.failed += 1
            if self.failed == 1:
                traceback.print_exc(file=sys.stderr)
