"""The process's loop: what the bus says, to those who listen."""

from __future__ import annotations

import functools
import logging
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import foxglove
from foxglove import Context
from foxglove.channels import FrameTransformsChannel, GridChannel, LogChannel, PointCloudChannel
from foxglove.websocket import ChannelView, Client, ServerListener

from ground_station.errors import GroundStationError
from ground_station.geometry.camera import Camera
from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    PayloadMessage,
    RecordingMessage,
)
from ground_station.service.cameras import camera_of
from ground_station.service.ending import RateLimitedLog
from ground_station.service.foxglove import documents, drawing, world
from ground_station.service.foxglove.payload import Make, Payload, Topic, json_topic
from ground_station.service.foxglove.world import World
from ground_station.service.settings import FoxgloveSettings, StationSettings
from pi_firmware.wire.errors import BlimpError, TelemetryError
from pi_firmware.wire.keys import check_payload_id

_LENGTH = 200


class RateLimitedHandler(logging.Handler):
    """Passes on one record of each logger a minute, with how many there were; warnings and up."""

    def __init__(self, log: RateLimitedLog) -> None:
        super().__init__(logging.WARNING)
        self._log_limited = log

    def emit(self, record: logging.LogRecord) -> None:
        """Takes a record, under the handler's lock."""
        try:
            self._log_limited(record.name, record.getMessage()[:_LENGTH])
        except Exception:
            self.handleError(record)


def install(log: RateLimitedLog) -> None:
    """Puts it in place of what Python would print."""
    logger = logging.getLogger("foxglove")
    logger.addHandler(RateLimitedHandler(log))
    logger.propagate = False


Task = Callable[[], object]
_MOST = 2000


class Inbox:
    """Tasks in their order, at most 2000.

    Never blocks who puts: a full inbox loses its oldest task. Safe from any thread.
    """

    def __init__(self) -> None:
        self._tasks: deque[Task] = deque(maxlen=_MOST)
        self._there = threading.Condition()

    def put(self, task: Task) -> None:
        """Leaves a task."""
        with self._there:
            self._tasks.append(task)
            self._there.notify()

    def take(self, timeout_s: float) -> list[Task]:
        """All there is; waits for something to come."""
        with self._there:
            self._there.wait_for(lambda: self._tasks, timeout_s)
            tasks = list(self._tasks)
            self._tasks.clear()
            return tasks


PAYLOADS, PLACES, EVENTS = 32, 64, 100
_POLL_S = 0.2
_BACKLOG = 256
"""Messages that may wait for one client; beyond it the oldest are dropped."""


class Publishing(ServerListener):
    """The server and its topics. Raises `GroundStationError` where it cannot listen."""

    def __init__(self, bus: Bus, folder: Path, settings: StationSettings) -> None:
        self._bus, self._folder, self._settings = bus, folder, settings
        self._inbox = Inbox()
        self._complain = RateLimitedLog(_print)
        self._context = Context()
        self._payloads: dict[str, Payload] = {}
        self._newest: dict[str, EstimateMessage] = {}  # of payloads elsewhere, too
        self._frames: dict[str, FrameMessage] = {}  # the newest of each payload
        self._flown: dict[str, str] = {}  # the map that each payload flies in
        self._events: deque[tuple[str, EventMessage]] = deque(maxlen=EVENTS)
        self._recording: tuple[RecordingMessage, int] | None = None
        self._reader = world.Reader(settings.map, self._take_world)
        self._camera: Camera | None = None
        try:
            self._camera = camera_of(settings.map, settings.map.folder)
        except BlimpError as error:
            self._complain("camera", f"no calibration: {error}")

        context = self._context
        self._tf = Topic(FrameTransformsChannel("/tf", context=context))
        self._plan = Topic(GridChannel("/map/floorplan", context=context))
        self._landmarks = Topic(PointCloudChannel("/map/landmarks", context=context))
        happened = functools.partial(self._happened, documents.event)
        self._event = json_topic("/events", documents.EVENT, context, happened)
        logged = functools.partial(self._happened, drawing.log)
        self._log = Topic(LogChannel("/log", context=context), logged)
        self._recorded = json_topic("/recording", documents.RECORDING, context, self._recalled)
        topics = (self._tf, self._event, self._log, self._recorded)
        self._topics = {topic.id: topic for topic in topics}
        self._of_map = (self._plan.id, self._landmarks.id)

        install(RateLimitedLog(_print))
        self.server = _listen(settings, context, self)
        bus.subscribe(bus_messages.FRAME, FrameMessage, self._hear_frame)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, self._later(self._take_estimate))
        bus.subscribe(bus_messages.ELSEWHERE, EstimateMessage, self._later(self._take_place))
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self._later(self._take_status))
        bus.subscribe(bus_messages.EVENT, EventMessage, self._later(self._take_event))
        bus.subscribe(bus_messages.RECORDING, RecordingMessage, self._later(self._take_recording))

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set."""
        while not stop.is_set():
            self._bus.heartbeat()
            for task in self._inbox.take(_POLL_S):
                self._do(task)

    def close(self) -> None:
        """Ends the server."""
        self.server.stop()

    def _do(self, task: Callable[[], object]) -> None:
        """A note that cannot be shown ends nothing."""
        try:
            task()
        except Exception as error:
            if self._complain("failed", f"not shown: {type(error).__name__}: {error}"):
                traceback.print_exc(file=sys.stderr)

    # Notes

    def _later(self, take: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
        return lambda payload_id, note: self._inbox.put(functools.partial(take, payload_id, note))

    def _hear_frame(self, payload_id: str, note: FrameMessage) -> None:
        known = self._payloads.get(payload_id)
        if known is None or known.wants(note):
            self._frames[payload_id] = note
            self._inbox.put(functools.partial(self._take_frame, payload_id, note))

    def _take_frame(self, payload_id: str, note: FrameMessage) -> None:
        if self._frames.get(payload_id) is not note:  # a newer one has come
            return
        if payload := self._payload(payload_id):
            payload.frame(note)

    def _take_estimate(self, payload_id: str, note: EstimateMessage) -> None:
        if payload := self._payload(payload_id):
            payload.estimate(note)
            self._take_place(payload_id, note)
            payload.see(note, self._newest)
            self._follow(payload_id, note.map)

    def _take_place(self, payload_id: str, note: EstimateMessage) -> None:
        self._newest.pop(payload_id, None)
        self._newest[payload_id] = note
        if len(self._newest) > PLACES:
            del self._newest[next(iter(self._newest))]

    def _take_status(self, payload_id: str, note: PayloadMessage) -> None:
        if payload := self._payload(payload_id):
            payload.status(note)

    def _take_event(self, payload_id: str, note: EventMessage) -> None:
        self._events.append((payload_id, note))
        self._event.publish(lambda: documents.event(payload_id, note), note.time_ns)
        self._log.publish(lambda: drawing.log(payload_id, note), note.time_ns)

    def _take_recording(self, _: str, note: RecordingMessage) -> None:
        self._recording = (note, time.time_ns())
        for make, log_ns in self._recalled():
            self._recorded.publish(make, log_ns)

    def _payload(self, payload_id: str) -> Payload | None:
        known = self._payloads.get(payload_id)
        if known is not None:
            return known
        try:
            check_payload_id(payload_id)
        except TelemetryError:
            return None
        if len(self._payloads) >= PAYLOADS and not self._free():
            self._complain("payloads", f"{payload_id}: more than {PAYLOADS} payloads")
            return None
        made = self._payloads[payload_id] = Payload(
            payload_id, self._context, self._folder, self._tf, self._camera, self._settings.http
        )
        self._topics |= {topic.id: topic for topic in made.topics}
        return made

    def _free(self) -> bool:
        """Forgets the first payload that is gone; False where none is."""
        gone = next((name for name, one in self._payloads.items() if not one.alive), None)
        if gone is None:
            return False
        payload = self._payloads.pop(gone)
        for topic in payload.topics:
            del self._topics[topic.id]
        payload.close()
        self._flown.pop(gone, None)
        self._frames.pop(gone, None)
        return True

    # What a new subscriber is told

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """On a thread of the server. A client's id is the number of its sink, too."""
        self._inbox.put(functools.partial(self._greet, client.id, channel.id))

    def _greet(self, client: int, channel: int) -> None:
        if channel in self._of_map:
            self._reader.ask(self._shown, (client, channel))
        elif topic := self._topics.get(channel):
            topic.greet(client)

    def _happened(self, make: Callable[[str, EventMessage], object]) -> Iterator[tuple[Make, int]]:
        for payload_id, note in self._events:
            yield functools.partial(make, payload_id, note), note.time_ns

    def _recalled(self) -> Iterator[tuple[Make, int]]:
        if self._recording is not None:
            note, log_ns = self._recording
            yield functools.partial(bus_messages.as_document, note), log_ns

    # The map

    @property
    def _shown(self) -> str:
        """The first payload's map, in the order of their names; the configured one without any."""
        if self._flown:
            return self._flown[min(self._flown)]
        return Path(self._settings.map.folder).resolve().name

    def _follow(self, payload_id: str, name: str) -> None:
        """Shows another map where the first payload flies in another."""
        if not name or self._flown.get(payload_id) == name:
            return
        before = self._shown
        self._flown[payload_id] = name
        if self._shown != before and (self._plan.wanted or self._landmarks.wanted):
            self._reader.ask(self._shown, (None, None))

    def _take_world(self, read: World, whom: Any) -> None:
        self._inbox.put(functools.partial(self._show, read, *whom))

    def _show(self, read: World, client: int | None, channel: int | None) -> None:
        now_ns = time.time_ns()
        if read.problem:
            self._complain("map", f"no map to show: {read.problem}")
            return
        plan = read.plan
        if plan is not None and channel in (None, self._plan.id):
            self._plan.publish(lambda: world.grid(plan, now_ns), now_ns, client)
        if channel in (None, self._landmarks.id):
            self._landmarks.publish(lambda: world.cloud(read.landmarks, now_ns), now_ns, client)


def _listen(settings: StationSettings, context: Context, listener: Publishing) -> Any:
    chosen: FoxgloveSettings = settings.foxglove
    try:
        return foxglove.start_server(
            name=f"blimp {settings.name}",
            host=chosen.host,
            port=chosen.port,
            context=context,
            server_listener=listener,
            message_backlog_size=_BACKLOG,
        )
    except Exception as error:
        reason = str(error).removeprefix("FoxgloveError: ").splitlines()[0][:160]
        where = f"foxglove.host {chosen.host}, foxglove.port {chosen.port}"
        raise GroundStationError(f"{where}: {reason}") from None


def _print(_: str, text: str) -> None:
    print(f"foxglove: {text}", file=sys.stderr, flush=True)
