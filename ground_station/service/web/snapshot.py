"""The station as its processes' notes tell it, in one place that every thread may ask.

All of it is bounded, whatever the notes say. Ages are measured on this process's monotonic clock
from when a value last came, so that no other clock's error makes an old value look new.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    PayloadMessage,
    ProcessMessage,
    RecordingMessage,
)
from ground_station.service.fleet.fleet import Fleet
from ground_station.service.settings import Run
from ground_station.service.web.trail import Trail
from pi_firmware.wire import messages
from pi_firmware.wire.errors import BlimpError, TelemetryError
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.telemetry import is_loopback

EVENTS, EVENTS_SHOWN, PAYLOADS, PROCESSES = 500, 200, 32, 32
POINTS = 300
TEXT = 500
_PROCESS_KEPT_S = 60.0
_GONE_S = 5.0
_MESSAGES = ("battery", "health", "autopilot")

STALE_S = {
    "payload": 3.0,
    "estimate": 1.0,
    "frame": 2.5,  # the gate lets a heartbeat through each second
    "battery": 15.0,
    "health": 15.0,
    "autopilot": 5.0,
}
"""Older than this a value says nothing of now."""

_ENDED = (messages.EVENT_STOPPED, messages.EVENT_END_OF_STREAM)


@dataclass
class _Payload:
    payload: PayloadMessage | None = None
    estimate: EstimateMessage | None = None
    came_ns: dict[str, int] = field(default_factory=dict)
    message_ns: dict[str, Any] = field(default_factory=dict)
    state_ns: int = 0
    nothing_ns: int | None = None  # since when frames have been localized in vain
    clock_ns: int | None = None  # since when the payload's clock is not known
    ended: bool = False
    alive_ns: int | None = None  # since when it is heard
    heard_ns: int | None = None  # when it was last
    trail: Trail = field(default_factory=Trail)


@dataclass
class _Process:
    note: ProcessMessage
    came_ns: int
    restarts: int = 0
    restarted_ns: int | None = None


class Snapshot:
    """What the station knows now. Safe from any thread."""

    def __init__(
        self, run: Run, version: str, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.run = run
        self.version = version
        self._clock_ns = clock_ns
        self._begun_ns = clock_ns()
        self._lock = threading.Lock()
        self._payloads: OrderedDict[str, _Payload] = OrderedDict()
        self._processes: dict[str, _Process] = {}
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)
        self._kept: Path | None = None
        self._lines = 0  # added to the file
        self._recording: RecordingMessage | None = None
        self._recording_ns = 0
        self._alarms: list[dict[str, Any]] = []
        self.job: Callable[[], dict[str, Any] | None] = lambda: None
        self.fleet: Callable[[], dict[str, Any] | None] = lambda: None
        self.evicted: Callable[[str], None] = lambda _: None
        """Gets the id of each payload that is forgotten."""

    def listen(self, bus: Bus | Fleet) -> None:
        """Hears everything on the bus."""
        bus.subscribe(bus_messages.FRAME, FrameMessage, self.frame)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, self.estimate)
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self.payload)
        bus.subscribe(bus_messages.EVENT, EventMessage, self.event)
        bus.subscribe(bus_messages.RECORDING, RecordingMessage, self.recording)
        bus.subscribe(bus_messages.PROCESS, ProcessMessage, self.process)

    def keep_events(self, path: Path) -> None:
        """Takes up the events that an earlier process of this run kept there, and keeps its own."""
        with contextlib.suppress(OSError), self._lock:
            for line in path.read_bytes().splitlines()[-EVENTS:]:
                with contextlib.suppress(BlimpError, ValueError, KeyError, TypeError):
                    note = bus_messages.decode(EventMessage, line)
                    payload_id = str(json.loads(line)["payload"])
                    self._events.append({**bus_messages.as_document(note), "payload": payload_id})
        self._kept, self._lines = path, EVENTS  # the first to come writes it again

    def _add(self, event: dict[str, Any]) -> None:
        """Call it with the lock held."""
        self._events.append(event)
        if self._kept is None:
            return
        self._lines += 1
        again = self._lines > EVENTS  # the file has twice as many at most
        text = "".join(json.dumps(one) + "\n" for one in (self._events if again else (event,)))
        with (
            contextlib.suppress(OSError),  # the run's folder is full
            self._kept.open("w" if again else "a") as file,
        ):
            file.write(text)
        self._lines = 0 if again else self._lines

    # What comes

    def frame(self, payload_id: str, _: FrameMessage) -> None:
        """A frame was received."""
        with self._lock:
            if (item := self._item(payload_id)) is not None:
                item.came_ns["frame"] = self._clock_ns()

    def estimate(self, payload_id: str, note: EstimateMessage) -> None:
        """A frame was localized, or not."""
        with self._lock:
            item = self._item(payload_id)
            if item is None:
                return
            now_ns = self._clock_ns()
            if item.estimate is None or item.estimate.state != note.state:
                item.state_ns = now_ns
            silent = now_ns - item.came_ns.get("estimate", 0) > 1e9 * STALE_S["estimate"]
            if note.position_m is not None:
                item.nothing_ns = None
            elif item.nothing_ns is None or silent:
                item.nothing_ns = now_ns
            item.came_ns["estimate"] = now_ns
            if len(note.points_px) > 2 * POINTS:
                note = dataclasses.replace(note, points_px=note.points_px[: 2 * POINTS])
            item.estimate = note
            if note.position_m and note.state in ("TRACKING", "DEGRADED"):
                item.trail.add(now_ns, note.position_m, begins=note.relocalized)

    def payload(self, payload_id: str, note: PayloadMessage) -> None:
        """How a payload is."""
        with self._lock:
            item = self._item(payload_id)
            if item is None:
                return
            now_ns = self._clock_ns()
            if not note.alive:
                item.alive_ns = None
            else:
                if not self._alive(item, now_ns):
                    item.alive_ns, item.ended = now_ns, False
                item.heard_ns = now_ns
            if note.clock is not None:
                item.clock_ns = None
            elif item.clock_ns is None:
                item.clock_ns = now_ns
            for name in _MESSAGES:
                message = getattr(note, name)
                if message is not None and message.time_ns != item.message_ns.get(name):
                    item.message_ns[name] = message.time_ns
                    item.came_ns[name] = now_ns
            item.came_ns["payload"] = now_ns
            item.payload = note

    def event(self, payload_id: str, note: EventMessage) -> None:
        """Something happened."""
        note = dataclasses.replace(note, text=note.text[:TEXT], name=note.name[:64])
        with self._lock:
            self._add({**bus_messages.as_document(note), "payload": payload_id})
            if note.source == "payload" and note.name in _ENDED and payload_id in self._payloads:
                self._payloads[payload_id].ended = True

    def recording(self, _: str, note: RecordingMessage) -> None:
        """How the recording is."""
        with self._lock:
            if self._recording is None and note.resumed:
                self._catch_up(note)
            self._recording, self._recording_ns = note, self._clock_ns()

    def _catch_up(self, note: RecordingMessage) -> None:
        """The event that was said before this process listened; call with the lock held."""
        text = note.resumed[:TEXT]
        if all(event["text"] != text for event in self._events):
            time_ns = time.time_ns() - int(1e9 * note.duration_s)
            event = EventMessage(
                time_ns, "intake", bus_messages.WARNING, bus_messages.RECORDING_RESUMED, text
            )
            self._add({**bus_messages.as_document(event), "payload": bus_messages.STATION})

    def process(self, _: str, note: ProcessMessage) -> None:
        """A process lives. One with another id than before was started again."""
        now_ns = self._clock_ns()
        with self._lock:
            before = self._processes.get(note.name)
            if before is None:
                if len(self._processes) < PROCESSES:
                    self._processes[note.name] = _Process(note, now_ns)
                return
            if note.pid != before.note.pid:
                before.restarts += 1
                before.restarted_ns = now_ns
            before.note, before.came_ns = note, now_ns

    def set_alarms(self, alarms: list[dict[str, Any]]) -> None:
        """Puts the alarms that stand now."""
        with self._lock:
            self._alarms = alarms

    # What is asked

    def payload_ids(self) -> list[str]:
        """All payloads that are known, those seen last at the end."""
        with self._lock:
            return list(self._payloads)

    def living(self) -> list[str]:
        """Payloads that are there now."""
        with self._lock:
            now_ns = self._clock_ns()
            return [name for name, item in self._payloads.items() if self._alive(item, now_ns)]

    def events(self) -> list[dict[str, Any]]:
        """What happened of late, the newest at the end."""
        with self._lock:
            return list(self._events)[-EVENTS_SHOWN:]

    def recorded_now(self) -> str:
        """The file that is being written; "" for none."""
        with self._lock:
            return self._recording.file if self._recording and self._recording.active else ""

    def document(self, *, full: bool = True) -> dict[str, Any]:
        """The whole state as plain JSON values; short of trails, points and events if not full."""
        job, fleet = self.job(), self.fleet()
        with self._lock:
            now_ns = self._clock_ns()
            station = self.run.station
            self._forget_processes(now_ns)
            recording = self._recording
            result: dict[str, Any] = {
                "now_ns": time.time_ns(),
                "station": {
                    "name": station.name,
                    "version": self.version,
                    "uptime_s": round(1e-9 * (now_ns - self._begun_ns), 1),
                    "started_ns": self.run.started_ns,
                    "map": Path(station.map.folder).name,
                    "demo": self.run.demo,
                    "loopback": is_loopback(station.video.host),
                    "min_free_MB": station.recording.min_free_MB,
                    "apart_m": station.payloads.apart_m,
                },
                "processes": [
                    {
                        **bus_messages.as_document(
                            dataclasses.replace(item.note, restarts=item.restarts)
                        ),
                        "age_s": _age_s(now_ns, item.came_ns),
                        "restarted_s": _age_s(now_ns, item.restarted_ns),
                    }
                    for item in self._processes.values()
                ],
                "payloads": {
                    name: self._payload_document(item, now_ns, full)
                    for name, item in self._payloads.items()
                },
                "recording": None if recording is None else bus_messages.as_document(recording),
                "recording_age_s": _age_s(now_ns, self._recording_ns if recording else None),
                "alarms": list(self._alarms),
                "job": job,
                "fleet": fleet,
            }
            if full:
                result["events"] = list(self._events)[-EVENTS_SHOWN:]
            return result

    def _payload_document(self, item: _Payload, now_ns: int, full: bool) -> dict[str, Any]:
        age_s = {name: _age_s(now_ns, item.came_ns.get(name)) for name in STALE_S}
        estimate = item.estimate
        if estimate is not None and not full:
            estimate = dataclasses.replace(estimate, points_px=[])
        alive = self._alive(item, now_ns)
        result: dict[str, Any] = {
            "payload": None if item.payload is None else bus_messages.as_document(item.payload),
            "estimate": None if estimate is None else bus_messages.as_document(estimate),
            "alive": alive,
            "alive_s": _age_s(now_ns, item.alive_ns) if alive else None,
            "gone_s": None if alive else _age_s(now_ns, item.heard_ns),
            "ended": item.ended,
            "age_s": age_s,
            "stale": [name for name, age in age_s.items() if age and age > STALE_S[name]],
            "state_s": _age_s(now_ns, item.state_ns if estimate else None),
            "nothing_known_s": _age_s(now_ns, item.nothing_ns),
            "clock_unknown_s": _age_s(now_ns, item.clock_ns),
        }
        if full:
            result["trail"], result["trail_breaks"] = item.trail.document()
        return result

    def _alive(self, item: _Payload, now_ns: int) -> bool:
        came_ns = item.came_ns.get("payload")
        if item.payload is None or came_ns is None:
            return False
        return bool(item.payload.alive) and now_ns - came_ns < _GONE_S * 1e9

    def _item(self, payload_id: str) -> _Payload | None:
        item = self._payloads.get(payload_id)
        if item is not None:
            return item
        try:
            check_payload_id(payload_id)
        except TelemetryError:
            return None
        if len(self._payloads) >= PAYLOADS:
            now_ns = self._clock_ns()
            gone = [name for name, old in self._payloads.items() if not self._alive(old, now_ns)]
            if not gone:
                return None
            oldest = min(gone, key=lambda name: max(self._payloads[name].came_ns.values()))
            del self._payloads[oldest]
            self.evicted(oldest)
        item = self._payloads[payload_id] = _Payload(came_ns={"first": self._clock_ns()})
        return item

    def _forget_processes(self, now_ns: int) -> None:
        for name, item in list(self._processes.items()):
            if now_ns - item.came_ns > _PROCESS_KEPT_S * 1e9:
                del self._processes[name]


def _age_s(now_ns: int, came_ns: int | None) -> float | None:
    return None if came_ns is None else round(1e-9 * (now_ns - came_ns), 3)
