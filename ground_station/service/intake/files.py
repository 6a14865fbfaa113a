"""What is in the ground's recordings, and when the next file begins.

Log times are this machine's clock throughout, so that what several payloads say lies side by side;
the video's and the poses' own timestamps stay the camera's, whose times a truth has, too. The first
payload with video has the topics of `pi_firmware.wire.recording`, any other the same behind its id,
as `/blimp-2/camera/video`. Telemetry lies under its Zenoh key, as `/blimp/blimp-1/battery`.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from ground_station.geometry.camera import Camera
from ground_station.recording.frames import CAMERA_TABLE, write_calibration
from ground_station.service import bus_messages
from ground_station.service.bus_messages import EstimateMessage
from pi_firmware.wire import annexb
from pi_firmware.wire.recorder import run
from pi_firmware.wire.recorder.file import RecordingFile
from pi_firmware.wire.recorder.run import Unit
from pi_firmware.wire.recording import CALIBRATION_TOPIC, ESTIMATE_TOPIC

ESTIMATE_STATE_TOPIC = "/estimate/state"
"""JSON: the whole estimate but for the pixels of its points."""
LACKS = ("damaged", "withheld", "lost")
"""Frames that were sent and are in no recording, by why; in the table `recording_end`."""
STATION_TOPIC = "/station"
"""Before what the service says: /station/event, /station/blimp-1/payload."""
MAP_TABLE = "map "
"""Behind this the names of metadata tables name the maps in which a recording was localized."""
AFTER_TABLE = "after "
"""Behind this, STATION/FILE: which recording of another station this one goes on from."""
_OVERLAP_S = 2.0
"""How long a file waits for the last frames of a stream whose next IDR does not come."""
_MOST_STREAMS = 64
_LATE_S = 5.0
"""A file that is due goes on in the next without an IDR when none came for so long."""


@dataclass(frozen=True, slots=True)
class JsonMessage:
    """JSON text for a topic."""

    topic: str
    schema: str
    log_ns: int
    text: bytes
    account: tuple[str, dict[str, int]] | None = None
    """Of a payload: its frames by fate."""


@dataclass(frozen=True, slots=True)
class Estimated:
    """A pose of one payload, or why there is none."""

    payload_id: str
    note: EstimateMessage
    log_ns: int


@dataclass
class _Stream:
    """A payload's video in the files: its topics' prefix, and the file that it is in now."""

    prefix: str
    file: RecordingFile | None = None
    begun: bool = False


class GroundRun(run.Run):
    """Takes `Unit`, `JsonMessage` and `Estimated`.

    A stream moves to the next file at its own IDR: nothing is lost between the two, and each file
    decodes by itself. The earlier one ends when all streams have moved.
    """

    def __init__(
        self,
        *args: Any,
        camera: Camera | None,
        max_file_s: float,
        sizes: dict[str, tuple[int, int]],
        after: str = "",
        **named: Any,
    ) -> None:
        super().__init__(*args, **named)
        self._camera, self._max_file_s, self._sizes = camera, max_file_s, sizes
        self._streams: dict[str, _Stream] = {}
        self._turned_s = time.monotonic()
        self._due_s: float | None = None
        self._maps: dict[str, str] = {}
        self._told_before: dict[str, dict[str, int]] = {}
        self._lacking: Counter[str] = Counter()
        if camera is not None:
            self._head[CAMERA_TABLE] = {"readout_s": repr(camera.readout_s)}
        if after:
            self._head[AFTER_TABLE + after] = {"recording": after}

    def _stamp(self) -> str:
        return datetime.now(UTC).strftime("-%Y%m%dT%H%M%SZ")

    def _put(self, item: object) -> None:
        self._end_left()
        if isinstance(item, Unit):
            try:
                self._unit(item)
            except Exception:
                self._left_out += 1
                raise
            return
        if self._is_due() and self._due_s is not None:
            if time.monotonic() - self._due_s > _LATE_S:
                self._turn()
            elif self._current.size_bytes > self._folder.file_limit_bytes + run.OVERRUN_BYTES:
                return
        if isinstance(item, JsonMessage):
            if item.account is not None:
                self._count(*item.account)
            self._write_message(item.topic, item.schema, item.log_ns, item.text)
        elif isinstance(item, Estimated):
            self._estimate(item)

    def _unit(self, unit: Unit) -> None:
        log_ns = unit.info.time_ns if unit.log_ns is None else unit.log_ns
        if unit.info.time_ns not in run.TIMES_NS or log_ns not in run.TIMES_NS:
            self._left_out += 1
            return
        idr = annexb.is_idr(unit.data)
        if self._is_due():
            assert self._due_s is not None
            if (idr and self._current.begun) or time.monotonic() - self._due_s > _LATE_S:
                self._turn()
            else:
                self._ask_for_idr()
        stream = self._streams.get(unit.stream)
        if stream is None:
            if not idr:
                return  # nothing is missing before the first
            if len(self._streams) >= _MOST_STREAMS:
                self._left_out += 1
                return
            stream = self._begin(unit.stream)
        if idr and stream.file is not self._current:
            stream.file = self._current
            self._calibrate(unit.stream, stream, log_ns)
        if stream.file is None:
            self._left_out += 1
            return
        stream.file.unit(unit.info, unit.data, idr=idr, prefix=stream.prefix, log_ns=log_ns)

    def _count(self, payload_id: str, told: dict[str, int]) -> None:
        """A payload's counts begin again with its session; its first are of before the file."""
        before = self._told_before.get(payload_id, told)
        self._told_before[payload_id] = told
        for fate in LACKS:
            now, then = told.get(fate, 0), before.get(fate, 0)
            self._lacking[fate] += now - then if now >= then else now

    def _lacks(self) -> dict[str, str]:
        told = {fate: str(self._lacking[fate]) for fate in LACKS}
        self._lacking.clear()
        return told

    def _begin(self, payload_id: str) -> _Stream:
        """A payload's first frame: its topics, told in this file and all that follow."""
        prefix = f"/{payload_id}" if self._streams else ""
        table = {"payload_id": payload_id, "topics": prefix}
        name = f"payload {payload_id}" if prefix else "payload"
        self._head[name] = table
        self._current.writer.write_metadata(name, table)
        stream = self._streams[payload_id] = _Stream(prefix)
        return stream

    def _calibrate(self, payload_id: str, stream: _Stream, log_ns: int) -> None:
        """Where the camera is known and of the size that its pictures have."""
        camera = self._camera
        if camera is None or self._sizes.get(payload_id) != (camera.width_px, camera.height_px):
            return
        topic = stream.prefix + CALIBRATION_TOPIC
        write_calibration(self._current.writer, camera, log_ns, topic)
        self._current.added(500)

    def _estimate(self, item: Estimated) -> None:
        stream = self._streams.get(item.payload_id)
        note = item.note
        if note.map and note.map != self._maps.get(item.payload_id):
            self._in_map(item.payload_id, note.map)
        if stream is None or note.time_ns not in run.TIMES_NS or item.log_ns not in run.TIMES_NS:
            return
        if note.position_m is not None and note.quaternion_xyzw is not None:
            self._current.writer.write_pose(
                note.time_ns,
                note.position_m,
                note.quaternion_xyzw,
                topic=stream.prefix + ESTIMATE_TOPIC,
                log_ns=item.log_ns,
            )
            self._current.added(120)
        document = bus_messages.as_document(note)
        del document["points_px"]  # they would be more than the video
        text = json.dumps(document, separators=(",", ":")).encode()
        topic = stream.prefix + ESTIMATE_STATE_TOPIC
        self._write_message(topic, "blimp.estimate", item.log_ns, text)

    def _in_map(self, payload_id: str, name: str) -> None:
        """Says, in this file and all that follow, in which map a payload is localized now."""
        self._head.pop(MAP_TABLE + self._maps.get(payload_id, ""), None)
        self._maps[payload_id] = name
        for one in self._maps.values():
            if MAP_TABLE + one not in self._head:
                self._head[MAP_TABLE + one] = {"name": one}
                self._current.writer.write_metadata(MAP_TABLE + one, {"name": one})

    def _write_message(self, topic: str, schema: str, log_ns: int, text: bytes) -> None:
        if log_ns in run.TIMES_NS:
            self._current.writer.write_json_text(topic, log_ns, text, schema_name=schema)
            self._current.added(len(text))

    def _is_due(self) -> bool:
        """Whether the file of now has its size or age."""
        now_s = time.monotonic()
        due = now_s - self._turned_s >= self._max_file_s or self._current.is_full(
            self._folder.file_limit_bytes
        )
        self._due_s = None if not due else now_s if self._due_s is None else self._due_s
        return due

    def _turn(self) -> None:
        super()._turn()
        self._turned_s, self._due_s = time.monotonic(), None

    def _end_left(self) -> None:
        """Ends earlier files that nobody writes to any more."""
        for file in self._files[:-1]:
            users = [stream for stream in self._streams.values() if stream.file is file]
            if users and time.monotonic() - self._turned_s < _OVERLAP_S:
                continue
            for stream in users:
                stream.file = None
            self._end_earlier(file)
