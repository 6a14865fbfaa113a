"""A recording played back to one viewer, over the live channel's own messages.

The page that shows a flight shows it again: the snapshot and the alarms are the live ones, on a
clock that runs with the recording. A time is sought from some seconds before it, so that pictures
can be decoded and every value is there.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from ground_station.service import alarms, bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    PayloadMessage,
)
from ground_station.service.fleet.shelf import Elsewhere
from ground_station.service.settings import Run
from ground_station.service.web import video
from ground_station.service.web.live import STATE_S
from ground_station.service.web.recordings import Recordings
from ground_station.service.web.snapshot import Snapshot
from ground_station.service.web.tape import Tape, TimedMessage
from ground_station.service.web.viewer import (
    FAILED,
    TRY_LATER,
    Broken,
    Viewer,
    close,
    finite,
    may_stay,
    said,
)
from pi_firmware.wire import sei
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import VIDEO_TOPIC

AT_ONCE = 2
"""Each takes a share of a core that the flight may need."""
SLOWEST, FASTEST = 0.1, 16.0
_LEAD_NS, _DECODE_NS = 10_000_000_000, 1_500_000_000
"""Heard and decoded before the time that is sought; an IDR comes each second."""
_BEHIND_NS = 1_000_000_000
_BREATH_S = 1.0
_SAME = {"offset_ns": 0, "uncertainty_ns": 0}
_REASON = 120


class Playback:
    """Plays a tape on a thread of its own until it is closed; `post` calls on the viewer's loop."""

    def __init__(
        self, tape: Tape, run: Run, version: str, viewer: Viewer, post: Callable[..., object]
    ) -> None:
        station = run.station
        where = dataclasses.replace(station.map, folder=tape.map or station.map.folder)
        self._run = dataclasses.replace(
            run, demo=False, station=dataclasses.replace(station, map=where)
        )
        self._tape, self._version, self._viewer, self._post = tape, version, viewer, post
        self._period_s, self._quality = 1 / station.http.video_rate_hz, station.http.jpeg_quality
        self._there = threading.Condition()
        self._closed, self._sought = False, 0
        self._playing, self._rate = True, 1.0
        self._base_ns, self._base_s = tape.begin_ns, time.monotonic()
        self._state_due_s = self._picture_due_s = 0.0
        self._thread = threading.Thread(target=self._play, name="playback", daemon=True)

    def start(self) -> None:
        """Plays from the beginning."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread soon."""
        with self._there:
            self._closed = True
            self._there.notify()

    def heard(self, message: dict[str, Any]) -> None:
        """What the viewer says; raises `Broken` for what is no message."""
        kind = message["type"]
        if kind == "select":
            if message.get("payload") not in self._tape.payloads:
                raise Broken("select: payload is not of this recording")
            self._viewer.payload_id = message["payload"]
            self._viewer.outbox.queue(said("selected", payload=self._viewer.payload_id))
            self._seek(self._now_ns())
        elif kind == "video":
            if not isinstance(message.get("on"), bool):
                raise Broken("video: on is true or false")
            self._viewer.video = message["on"]
        elif kind == "play":
            if not isinstance(message.get("on"), bool):
                raise Broken("play: on is true or false")
            ended = message["on"] and self._now_ns() >= self._tape.end_ns
            with self._there:
                self._pace(message["on"], self._rate)
            if ended:
                self._seek(self._tape.begin_ns)
        elif kind == "rate":
            rate = finite(message.get("rate"), "rate: rate")
            if not SLOWEST <= rate <= FASTEST:
                raise Broken(f"rate: {SLOWEST} to {FASTEST:g}")
            with self._there:
                self._pace(self._playing, rate)
        elif kind == "seek":
            at_s = finite(message.get("at_s"), "seek: at_s")
            self._seek(self._tape.begin_ns + int(1e9 * min(max(at_s, 0.0), 1e9)))

    def _now_ns(self) -> int:
        """The recording's time that is shown now."""
        gone_s = (time.monotonic() - self._base_s) * self._rate if self._playing else 0.0
        return min(self._base_ns + int(1e9 * gone_s), self._tape.end_ns)

    def _pace(self, playing: bool, rate: float, at_ns: int | None = None) -> None:
        """Call it with the condition held."""
        self._base_ns = self._now_ns() if at_ns is None else at_ns
        self._base_s, self._playing, self._rate = time.monotonic(), playing, rate
        self._state_due_s = 0.0
        self._there.notify()

    def _seek(self, at_ns: int) -> None:
        with self._there:
            self._pace(self._playing, self._rate, min(at_ns, self._tape.end_ns))
            self._sought += 1

    # On its own thread

    def _play(self) -> None:
        try:
            while not self._closed:
                with self._there:
                    sought, at_ns = self._sought, self._now_ns()
                self._play_from(at_ns, sought)
        except Exception as error:
            if not isinstance(error, BlimpError):
                traceback.print_exc(file=sys.stderr)
            self._post(self._viewer.end, FAILED, str(error)[:_REASON])

    def _play_from(self, at_ns: int, sought: int) -> None:
        """Until another time is sought; the end is waited at."""
        from ground_station.recording.h264 import Decoder

        self._at_ns = at_ns
        self._snapshot = Snapshot(self._run, self._version, lambda: self._at_ns)
        self._alarms: dict[str, alarms.Standing] = {}
        self._decoder, self._picture = Decoder(), b""
        greeted = False
        for heard in self._tape.since(at_ns - _LEAD_NS):
            if heard.log_ns < at_ns:
                self._at_ns = heard.log_ns
                self._take(heard, shown=False, decoded=heard.log_ns >= at_ns - _DECODE_NS)
                if self._sought != sought or self._closed:
                    return
                continue
            if not greeted:
                greeted = True
                self._greet(at_ns)
            if not self._waited(heard.log_ns, sought):
                return
            self._at_ns = heard.log_ns
            self._take(heard, shown=True, decoded=True)
        if not greeted:
            self._greet(at_ns)
        with self._there:
            if self._sought == sought:
                self._pace(False, self._rate, self._tape.end_ns)
        self._waited(1 << 63, sought)

    def _greet(self, at_ns: int) -> None:
        with self._there:  # what came before the time took its while
            self._pace(self._playing, self._rate, at_ns)
        self._at_ns = at_ns
        tape = self._tape
        length_s = round(1e-9 * (tape.end_ns - tape.begin_ns), 3)
        text = said(
            "hello",
            now_ns=at_ns,
            payload=self._viewer.payload_id,
            video=self._viewer.video,
            video_rate_hz=round(1 / self._period_s, 3),
            tape={"begin_ns": tape.begin_ns, "length_s": length_s, "marks": tape.marks},
            state=self._document(full=True),
        )
        self._post(self._viewer.outbox.queue, text)
        if self._picture:
            self._post(self._viewer.outbox.show, self._picture)

    def _waited(self, log_ns: int, sought: int) -> bool:
        """Tells the state until a time has come; False where another is sought or all is over."""
        while True:
            if time.monotonic() >= self._state_due_s:
                self._state_due_s = time.monotonic() + STATE_S
                self._at_ns = max(self._at_ns, min(self._now_ns(), log_ns))
                text = said("state", **self._document(full=False))
                self._post(self._viewer.outbox.replace, "state", text)
            with self._there:
                if self._closed or self._sought != sought:
                    return False
                ahead_ns = log_ns - self._now_ns()
                if ahead_ns <= 0:
                    if -ahead_ns > _BEHIND_NS * self._rate:  # this machine is slower than the rate
                        self._pace(self._playing, self._rate, log_ns)
                    return True
                wait_s = 1e-9 * ahead_ns / self._rate if self._playing else STATE_S
                self._there.wait(min(wait_s, STATE_S))

    def _document(self, full: bool) -> dict[str, Any]:
        document = self._snapshot.document(full=full)
        document["now_ns"] = self._at_ns
        judged = {**document, "events": self._snapshot.events()}
        self._alarms = alarms.judge(judged, self._at_ns, self._alarms)
        document["alarms"] = alarms.documents(self._alarms)
        at_s = round(1e-9 * (self._at_ns - self._tape.begin_ns), 3)
        document["playback"] = {"at_s": at_s, "playing": self._playing, "rate": self._rate}
        return document

    def _take(self, heard: TimedMessage, *, shown: bool, decoded: bool) -> None:
        note, payload_id, outbox = heard.note, heard.payload_id, self._viewer.outbox
        if heard.kind == VIDEO_TOPIC:
            if not self._tape.told:
                self._snapshot.payload(payload_id, PayloadMessage(True, heard.log_ns, clock=_SAME))
            if decoded and payload_id == self._viewer.payload_id:
                self._decode(heard, shown)
        elif isinstance(note, EstimateMessage):
            self._snapshot.estimate(payload_id, note)
            if shown:
                document = bus_messages.as_document(note)
                text = said("estimate", payload=payload_id, estimate=document)
                self._post(outbox.replace, f"estimate/{payload_id}", text)
        elif isinstance(note, PayloadMessage):
            self._snapshot.payload(payload_id, note)
        elif isinstance(note, EventMessage):
            self._snapshot.event(payload_id, note)
            if shown:
                document = {**bus_messages.as_document(note), "payload": payload_id}
                self._post(outbox.queue, said("event", event=document))

    def _decode(self, heard: TimedMessage, shown: bool) -> None:
        """Each unit is decoded; a picture is encoded as often as live ones are."""
        import cv2

        from ground_station.recording.h264 import grey

        info = sei.find(heard.video)
        for _, frame in self._decoder.decode(heard.video, info.sequence if info else 0):
            sequence = int(frame.pts or 0)
            note = FrameMessage(
                0, 0, sequence, heard.log_ns, heard.log_ns, heard.log_ns,
                frame.width, frame.height, 0, heard.log_ns,
            )  # fmt: skip
            self._snapshot.frame(heard.payload_id, note)
            now_s = time.monotonic()
            if not self._viewer.video or (shown and now_s < self._picture_due_s):
                continue
            done, jpeg = cv2.imencode(
                ".jpg", grey(frame), [cv2.IMWRITE_JPEG_QUALITY, self._quality]
            )
            if not done:
                continue
            self._picture = video.message(heard.payload_id, note, jpeg.tobytes())
            if shown:
                self._picture_due_s = now_s + 0.75 * self._period_s
                self._post(self._viewer.outbox.show, self._picture)


async def _breathe(viewer: Viewer) -> None:
    """A page takes silence for a broken connection, and a cut recording's times are far apart."""
    while True:
        viewer.outbox.replace("reading", said("reading"))
        await asyncio.sleep(_BREATH_S)


def router(
    recorded: Recordings,
    elsewhere: Callable[[str], Elsewhere],
    named: Callable[[EstimateMessage], EstimateMessage],
    run: Run,
    version: str,
    holds: Callable[[str], bool],
) -> APIRouter:
    """The WebSockets of recordings; `holds` as for the live one.

    `elsewhere` is the shelf of another station, by its name, and `named` a pose of it as this
    station names its map.
    """
    result = APIRouter()
    places = asyncio.Semaphore(AT_ONCE)

    @result.websocket("/api/recordings/{file}/play")
    async def play(socket: WebSocket, file: str) -> None:
        await _play(socket, lambda: Tape(recorded.path(file)))

    @result.websocket("/api/stations/{station}/recordings/{file}/play")
    async def play_elsewhere(socket: WebSocket, station: str, file: str) -> None:
        await _play(socket, lambda: Tape(elsewhere(station).file(file), named))

    async def _play(socket: WebSocket, tape_of: Callable[[], Tape]) -> None:
        await socket.accept()
        if places.locked():
            await close(socket, TRY_LATER, f"{AT_ONCE} recordings are played back already")
            return
        async with places:
            reading = asyncio.create_task(asyncio.to_thread(tape_of))
            try:
                while not (await asyncio.wait({reading}, timeout=_BREATH_S))[0]:
                    await socket.send_text(said("reading"))
                tape = reading.result()
            except (BlimpError, OSError) as error:
                await close(socket, TRY_LATER, str(error)[:_REASON])
                return
            except (WebSocketDisconnect, RuntimeError):
                return
            viewer = Viewer(tape.payloads[0] if tape.payloads else None)
            loop = asyncio.get_running_loop()

            def post(call: Callable[..., object], *arguments: Any) -> None:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(call, *arguments)

            playback = Playback(tape, run, version, viewer, post)
            playback.start()
            breathing = asyncio.create_task(_breathe(viewer))
            try:
                code, reason = await viewer.serve(socket, playback.heard, may_stay(socket, holds))
            finally:
                breathing.cancel()
                playback.close()
        await close(socket, code, reason)

    return result
