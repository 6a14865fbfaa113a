"""The live channel: what the bus says, to every viewer, at the pace each can take."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, WebSocket

from ground_station.service import alarms, bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    RecordingMessage,
)
from ground_station.service.fleet.fleet import Fleet
from ground_station.service.settings import HttpSettings
from ground_station.service.web.metrics import Metrics
from ground_station.service.web.snapshot import PAYLOADS, TEXT, Snapshot
from ground_station.service.web.video import Video
from ground_station.service.web.viewer import (
    ENDS,
    TRY_LATER,
    Broken,
    Viewer,
    close,
    finite,
    may_stay,
    said,
)

STATE_S = 0.25
_LONGEST_SHOWN_MS = 60_000.0
_ESTIMATES_HZ, _OTHERS_HZ = 30.0, 5.0


class Live:
    """All viewers; its methods are for the event loop, but for what `listen` hears."""

    def __init__(
        self, snapshot: Snapshot, metrics: Metrics, settings: HttpSettings, video: Video | None
    ) -> None:
        self._snapshot, self._metrics, self._settings = snapshot, metrics, settings
        self.video = video
        self._viewers: set[Viewer] = set()
        self._alarms: dict[str, alarms.Standing] = {}
        self._alive: frozenset[str] = frozenset()
        self._job_ran = False
        self._publish_event: Callable[[str, EventMessage], None] = lambda *_: None
        self._fleet: Fleet | None = None

    # What the bus says

    def listen(self, bus: Bus | Fleet, loop: asyncio.AbstractEventLoop) -> None:
        """Hears what viewers are told; the bus's threads only hand it over."""
        self._fleet = bus if isinstance(bus, Fleet) else None

        def later(call: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
            def hand_over(payload_id: str, note: Any) -> None:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(call, payload_id, note)

            return hand_over

        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, later(self.estimate))
        bus.subscribe(bus_messages.EVENT, EventMessage, later(self.event))
        bus.subscribe(bus_messages.RECORDING, RecordingMessage, later(self.recording))
        if self.video is not None:
            bus.subscribe(bus_messages.FRAME, FrameMessage, self.video.frame)
        self._publish_event = lambda payload_id, note: bus.publish(
            bus_messages.EVENT, payload_id, note
        )

    def estimate(self, payload_id: str, note: EstimateMessage) -> None:
        """Each viewer gets its own payload's at once, those of others now and then."""
        now_s = time.monotonic()
        texts: dict[bool, str] = {}
        for viewer in self._viewers:
            own = viewer.payload_id == payload_id
            period_s = 1.0 / (_ESTIMATES_HZ if own else _OTHERS_HZ)
            due_s = viewer.due_s.get(payload_id, 0.0)
            if now_s < due_s - period_s / 4:
                continue
            viewer.due_s[payload_id] = max(due_s, now_s - period_s) + period_s
            if len(viewer.due_s) > PAYLOADS:
                viewer.due_s.clear()
            if own not in texts:
                document = bus_messages.as_document(note)
                document["points_px"] = document["points_px"][:600] if own else []
                texts[own] = said("estimate", payload=payload_id, estimate=document)
            viewer.outbox.replace(f"estimate/{payload_id}", texts[own])

    def event(self, payload_id: str, note: EventMessage) -> None:
        """Everybody is told."""
        document = bus_messages.as_document(note)
        document["text"] = document["text"][:TEXT]
        self._send_to_viewers(said("event", event={**document, "payload": payload_id}))

    def recording(self, _: str, note: RecordingMessage) -> None:
        """Everybody is told the newest."""
        text = said("recording", recording=bus_messages.as_document(note))
        for viewer in self._viewers:
            viewer.outbox.replace("recording", text)

    def picture(self, payload_id: str, message: bytes) -> None:
        """Everybody who looks at this payload gets the same bytes."""
        for viewer in self._viewers:
            if viewer.video and viewer.payload_id == payload_id:
                viewer.outbox.show(message)

    # What the clock says

    async def tick(self) -> None:
        """Judges the alarms and tells the state, four times a second, for ever."""
        complained = False
        while True:
            try:
                self.step()
            except Exception:  # a message with values of other types than its own
                if not complained:
                    traceback.print_exc(file=sys.stderr)
                complained = True
            await asyncio.sleep(STATE_S)

    def step(self) -> None:
        """One tick."""
        state = self._snapshot.document(full=False)
        before = self._alarms
        judged = {**state, "events": self._snapshot.events()}
        self._alarms = alarms.judge(judged, time.time_ns(), before)
        state["alarms"] = alarms.documents(self._alarms)
        if self._fleet is not None:
            own = [standing.alarm for standing in self._alarms.values()]
            cpu = sum(process["cpu"] for process in state["processes"])
            self._fleet.publish_state(own, self._looked_at(), cpu)
            state["alarms"] += self._fleet.where.alarms()
            self._want()
        self._snapshot.set_alarms(state["alarms"])
        for name in self._alarms.keys() - before.keys():
            self._alarm(self._alarms[name].alarm, active=True)
        for name in before.keys() - self._alarms.keys():
            self._alarm(before[name].alarm, active=False)
        self._follow_job(state["job"])
        alive = frozenset(name for name, item in state["payloads"].items() if item["alive"])
        for payload_id in self._alive - alive:
            self._send_to_viewers(said("gone", payload=payload_id))
        self._alive = alive
        for viewer in self._viewers:
            if viewer.payload_id is None and alive:
                self._select(viewer, min(alive))
        if self._viewers:
            text = said("state", **state)
            for viewer in self._viewers:
                viewer.outbox.replace("state", text)

    def _alarm(self, alarm: alarms.Alarm, active: bool) -> None:
        self._send_to_viewers(said("alarm", active=active, alarm=vars(alarm)))
        if active:
            self._say(alarm.payload, alarm.level, "alarm-begins", f"alarm begins: {alarm.text}")
        else:
            text = f"alarm is over: {alarm.text}"
            self._say(alarm.payload, bus_messages.INFO, "alarm-over", text)

    def _follow_job(self, job: dict[str, Any] | None) -> None:
        runs = bool(job and job["running"])
        if job and self._job_ran and not runs:
            level = bus_messages.INFO if job["status"] == 0 else bus_messages.WARNING
            text = f"{job['command']}: {job['line'] or 'ended'}"
            self._say(bus_messages.STATION, level, "job-ended", text)
        self._job_ran = runs

    def _say(self, payload_id: str, level: bus_messages.Level, name: str, text: str) -> None:
        with contextlib.suppress(Exception):  # the bus may be what fails
            note = EventMessage(time.time_ns(), "web", level, name, text)
            self._publish_event(payload_id, note)

    def _send_to_viewers(self, text: str) -> None:
        for viewer in self._viewers:
            viewer.outbox.queue(text)

    # Viewers

    @property
    def viewers(self) -> int:
        """How many there are."""
        return len(self._viewers)

    async def serve(
        self, socket: WebSocket, payload_id: str | None, authorized: Callable[[], bool]
    ) -> None:
        """One connection from its acceptance to its end."""
        await socket.accept()
        if len(self._viewers) >= self._settings.viewers:
            reason = f"{self._settings.viewers} viewers are here already (http.viewers)"
            await socket.close(TRY_LATER, reason)
            return
        if payload_id not in self._snapshot.payload_ids():
            payload_id = min(self._snapshot.living(), default=None)
        viewer = Viewer(payload_id, self._metrics.pictures_sent.inc)
        viewer.outbox.queue(self._hello(viewer))
        self._viewers.add(viewer)
        self._want()
        try:
            code, reason = await viewer.serve(
                socket, lambda message: self._heard(viewer, message), authorized
            )
        finally:
            self._viewers.discard(viewer)
            self._want()
            self._metrics.pictures_lost.inc(viewer.outbox.pictures_lost)
        await close(socket, code, reason)

    def close(self) -> None:
        """Tells all viewers that the service ends."""
        for viewer in self._viewers:
            viewer.end(ENDS, "the service ends")

    def _hello(self, viewer: Viewer) -> str:
        return said(
            "hello",
            now_ns=time.time_ns(),
            payload=viewer.payload_id,
            video=viewer.video,
            video_rate_hz=self._settings.video_rate_hz,
            state=self._snapshot.document(),
        )

    def _heard(self, viewer: Viewer, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "select":
            payload_id = message.get("payload")
            if not isinstance(payload_id, str) or len(payload_id) > 32:
                raise Broken("select: payload is no id")
            self._select(viewer, payload_id)
        elif kind == "video":
            if not isinstance(message.get("on"), bool):
                raise Broken("video: on is true or false")
            viewer.video = message["on"]
            viewer.outbox.forget_picture()
            self._want()
        elif kind == "shown":
            shown_ms = finite(message.get("shown_ms"), "shown: shown_ms")
            if viewer.payload_id is not None and 0 <= shown_ms <= _LONGEST_SHOWN_MS:
                self._metrics.shown(viewer.payload_id, shown_ms / 1e3)
        elif kind == "ping":
            sent_ms = finite(message.get("sent_ms", 0), "ping: sent_ms")
            viewer.outbox.queue(said("pong", sent_ms=sent_ms, now_ns=time.time_ns()))

    def _select(self, viewer: Viewer, payload_id: str) -> None:
        if payload_id in self._snapshot.payload_ids():
            viewer.payload_id = payload_id
        viewer.outbox.forget_picture()
        viewer.outbox.queue(said("selected", payload=viewer.payload_id))
        self._want()

    def _want(self) -> None:
        if self.video is not None:
            elsewhere = self._fleet.where.wanted() if self._fleet is not None else frozenset()
            self.video.want(self._looked_at() | elsewhere)

    def _looked_at(self) -> frozenset[str]:
        return frozenset(v.payload_id for v in self._viewers if v.video and v.payload_id)


def router(live: Live, holds: Callable[[str], bool]) -> APIRouter:
    """The WebSocket; `holds` tells whether a session's cookie is still good."""
    result = APIRouter()

    @result.websocket("/api/live")
    async def serve(socket: WebSocket, payload: str | None = None) -> None:
        await live.serve(socket, payload, may_stay(socket, holds))

    return result
