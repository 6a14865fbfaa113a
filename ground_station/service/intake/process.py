"""The intake put together: video and telemetry in, pictures, notes and recordings out."""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.service import bus_messages
from ground_station.service.alarms import UNLISTED
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    LeaveMessage,
    Level,
    Message,
)
from ground_station.service.ending import CannotGoOn
from ground_station.service.intake import poses
from ground_station.service.intake.payloads import Payload, Publish
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.intake.roster import NAMELESS, Announced, Roster
from ground_station.service.settings import StationSettings
from ground_station.stream import command
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.feedback import Awaited, Feedback, Video
from ground_station.stream.multi_stream import MultiStreamReceiver
from ground_station.stream.srtp import load_keys
from ground_station.stream.telemetry import TelemetryListener
from pi_firmware.wire import messages
from pi_firmware.wire.keys import check_payload_id
from pi_firmware.wire.telemetry import Session

_PAYLOADS_S, _RECORDING_S = 0.5, 1.0
_STOP_S = 3.5
_IDR_S = 1.0
_LOST_S = 1.0
"""Of a stepped flight, which waits meanwhile: when nothing more came for so long, a frame that was
sent is lost."""
_NAME_LENGTH, _TEXT_LENGTH = 64, 500
_TOLD = 256
_EARLY, _EARLY_S = 64, 3.0
_LEFT_S = 2.0
_ANSWER_S = 2.0
"""For the payload to be found, and again for its answer: who asks waits for 5 s."""
_AFTER = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}/[A-Za-z0-9][A-Za-z0-9_.:+-]{0,127}\.mcap")

_LEVELS: dict[str, Level] = {
    messages.EVENT_FAILED: bus_messages.ALARM,
    messages.EVENT_BATTERY_CRITICAL: bus_messages.ALARM,
    messages.EVENT_BATTERY_LOW: bus_messages.WARNING,
    messages.EVENT_GAUGE_FAILED: bus_messages.WARNING,
    messages.EVENT_CAMERA_RESTARTED: bus_messages.WARNING,
    messages.EVENT_ENCODER_RESTARTED: bus_messages.WARNING,
    messages.EVENT_RADIO_RESTARTED: bus_messages.WARNING,
    messages.EVENT_RADIO_FAILED: bus_messages.WARNING,
    messages.EVENT_SOURCE_CUT: bus_messages.WARNING,
}


class Intake:
    """Takes up payloads from its start until `close`; `step` it several times a second.

    `publish` reaches all processes, `folder` is where pictures go (None: none are shown). `stepped`
    is for payloads that wait for poses: they are told the newest again at each step. Raises a
    `BlimpError` with one line when a port is in use or a folder of certificates is not one.
    """

    def __init__(
        self,
        settings: StationSettings,
        publish: Publish,
        *,
        folder: Path | None = None,
        camera: Camera | None = None,
        stepped: bool = False,
    ) -> None:
        self._publish_message, self._folder, self._stepped = publish, folder, stepped
        self._announced = Announced()
        self._roster = Roster(settings.payloads, self._announced, self._make)
        self._told: dict[str, str] = {}
        self._left: frozenset[str] = frozenset()
        self._left_s = 0.0
        self._stands: dict[str, tuple[float, int]] = {}
        self._early: deque[tuple[float, str, messages.Event]] = deque(maxlen=_EARLY)
        self._due_s = {"payloads": 0.0, "recording": 0.0}
        self._stack = contextlib.ExitStack()
        self.recorder = GroundRecorder(
            settings.recording, self.report, camera=camera, force_idr=self._force_idrs
        )
        self._stack.callback(self.recorder.close, _STOP_S)
        try:
            self._open(settings)
        except BaseException:
            self._stack.close()
            raise

    def _open(self, settings: StationSettings) -> None:
        certificates = settings.telemetry.certificates
        srtp_keys = load_keys(certificates) if certificates else None
        self._listener = TelemetryListener(
            settings.telemetry.listen,
            connect=settings.telemetry.connect,
            certificates=certificates,
            discoverable=settings.telemetry.discoverable,
            on_message=self._heard,
        )
        self._stack.callback(self._listener.close)
        self._feed = poses.PoseFeed(self._listener.session)
        self.video = MultiStreamReceiver(
            settings.video.port,
            settings.video.host,
            owner=self._roster.owner,
            on_frame=self._take,
            max_streams=settings.payloads.most,
            srtp_keys=srtp_keys,
        )
        feedback = Feedback(self._listener, self._video_of)
        # In this order at the end: what has come is decoded and recorded, then all is let go of.
        self._stack.callback(self.recorder.close, _STOP_S)
        self._stack.callback(self.video.close)
        self._stack.callback(feedback.close)

    def __enter__(self) -> Intake:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the recording within some seconds, and everything else."""
        self._stack.close()
        for payload in self._roster.all():
            payload.close()

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where telemetry is listened to."""
        return self._listener.endpoints

    def step(self) -> None:
        """Says how payloads and recording are, when it is time to.

        Raises `CannotGoOn` when nothing can be received any more.
        """
        if self.video.failure:
            raise CannotGoOn(self.video.failure)
        now_s = time.monotonic()
        if self._stepped:
            self._feed.again()
            for payload in self._roster.all():
                self._answer_lost(payload, now_s)
        if now_s >= self._due_s["payloads"]:
            self._due_s["payloads"] = now_s + _PAYLOADS_S
            self._follow()
        if now_s >= self._due_s["recording"]:
            self._due_s["recording"] = now_s + _RECORDING_S
            self._publish(bus_messages.RECORDING, bus_messages.STATION, self.recorder.state())

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Answers a question of the bus; raises a `BlimpError` for what cannot be done."""
        what = request.get("do")
        if what == "endpoints":
            return {"video_port": self.video.port, "telemetry": list(self.endpoints)}
        if what == "record-start":
            after = request.get("after", "")
            if not isinstance(after, str) or (after and not _AFTER.fullmatch(after)):
                raise InputError(f"'after' is {str(after)[:40]!r}; allowed: STATION/FILE.mcap")
            return {"file": self.recorder.start(after)}
        if what == "record-stop":
            return {"file": self.recorder.stop()}
        if what == "payload-command":
            return _command(request, self._listener.session)
        raise InputError(
            f"'do' is {str(what)[:40]!r}; allowed: record-start, record-stop, payload-command"
        )

    def estimated(self, payload_id: str, note: EstimateMessage) -> None:
        """Takes a pose: it goes to its payload, and into the recording."""
        self._feed.send(payload_id, poses.pose_message(note, time.time_ns()))
        self.recorder.estimate(payload_id, note)

    def report(self, name: str, level: Level, text: str) -> None:
        """Says an event of the recorder's."""
        self._event("intake", level, name, text, bus_messages.STATION)
        self._due_s["recording"] = 0.0

    def leave(self, _: str, note: LeaveMessage) -> None:
        """Says nothing to some payloads, which go on with another station that does."""
        self._left, self._left_s = frozenset(note.payloads), time.monotonic()

    def heard_event(self, payload_id: str, note: EventMessage) -> None:
        """Takes another process's event, for the recording."""
        if note.source not in ("intake", "payload"):
            self.recorder.note(bus_messages.EVENT, payload_id, note)

    def _make(self, payload_id: str) -> Payload:
        payload = Payload(payload_id, self._folder, self._publish, self.recorder)
        payload.clock = lambda: self._listener.clock(payload_id)
        return payload

    def _video_of(self, payload_id: str) -> Video | None:
        """A payload's stream, or none yet: one that looks for its station sends when it is told.

        None for one that is left to another station, to which nothing is said.
        """
        if payload_id in self._left and time.monotonic() - self._left_s < _LEFT_S:
            return None
        awaited = Awaited(self.video.port) if self._roster.get(payload_id) is not None else None
        return self.video.stream_of(payload_id) or awaited

    def _take(self, payload_id: str, frame: ReceivedFrame) -> None:
        payload = self._roster.take_up(payload_id)
        if payload is not None:
            if payload.stream is None or payload.stream.ssrc != frame.ssrc:
                payload.follow(self.video.stream_of(payload_id))
            payload.take(frame)

    def _heard(self, payload_id: str, kind: str, message: messages.Message) -> None:
        """A message of a payload, on a thread of the session."""
        if isinstance(message, messages.Gate):
            self._announced.said(payload_id, message.ssrc)
        elif isinstance(message, messages.Event):
            self._payload_said(payload_id, message)
        payload = self._roster.get(payload_id)
        if payload is not None:
            payload.seen_ns = time.time_ns()
            self.recorder.message(payload_id, kind, message)

    def _payload_said(self, payload_id: str, event: messages.Event) -> None:
        if "ssrc" in event.values:
            self._announced.said(payload_id, event.values["ssrc"])
        if self._roster.get(payload_id) is None:
            # It may be heard before it is seen to live, which is when it is taken up.
            self._early.append((time.monotonic(), payload_id, event))
        else:
            self._pass_on(payload_id, event)

    def _pass_on(self, payload_id: str, event: messages.Event) -> None:
        level = _LEVELS.get(event.name, bus_messages.INFO)
        payload = self._roster.get(payload_id)
        if payload is not None and event.name == messages.EVENT_STARTED:
            payload.started_ns = event.time_ns
        name, text = event.name[:_NAME_LENGTH], event.text[:_TEXT_LENGTH]
        self._event("payload", level, name, text, payload_id)

    def _pass_on_early(self) -> None:
        """Events of payloads that are taken up by now; who does not live after a moment is left."""
        for _ in range(len(self._early)):
            at_s, payload_id, event = self._early.popleft()
            if self._roster.get(payload_id) is not None:
                self._pass_on(payload_id, event)
            elif time.monotonic() - at_s < _EARLY_S:
                self._early.append((at_s, payload_id, event))

    def _answer_lost(self, payload: Payload, now_s: float) -> None:
        """Where all that came of one that waits is answered and no more comes, that is lost."""
        state, told = self._listener.state(payload.id), self._feed.newest(payload.id)
        if state is None or state.gate is None:
            return
        answered, newest = told.sequence if told is not None else -1, state.gate.sequence
        is_behind = self.video.behind(state.gate.ssrc)
        if is_behind or self._stands.get(payload.id, (0.0, -1))[1] != newest:
            self._stands[payload.id] = now_s, newest
        elif (
            payload.last_sequence <= answered < newest
            and now_s - self._stands[payload.id][0] > _LOST_S
        ):
            pose = messages.Pose(time.time_ns(), state.gate.capture_ns, newest, "LOST")
            self._feed.send(payload.id, pose)

    def _follow(self) -> None:
        """Looks after each payload, and says how it is."""
        living = set(self._listener.living())
        for payload_id in living:
            self._roster.take_up(payload_id, elsewhere=bool(self._elsewhere(payload_id)))
        self._pass_on_early()
        for payload in self._roster.all():
            was_alive, payload.alive = payload.alive, payload.id in living or payload.streaming
            if payload.alive and not was_alive:
                text = f"{payload.id} is here"
                self._event("intake", bus_messages.INFO, "payload-appeared", text, payload.id)
            elif was_alive and not payload.alive:
                text = f"{payload.id} is gone"
                self._event("intake", bus_messages.WARNING, "payload-gone", text, payload.id)
            payload.follow(self.video.stream_of(payload.id))
            stream = payload.stream
            self._report_once(payload.id, "stream-problem", stream.problem if stream else "")
            disputed = self._announced.disputed(payload.id)
            text = "two payloads call themselves so; the first one's video is kept"
            self._report_once(payload.id, "payload-twice", text if disputed else "")
            note = payload.note(
                self._listener.state(payload.id), self._listener, encrypted=self.video.encrypted
            )
            self._publish(bus_messages.PAYLOAD, payload.id, note)
            self.recorder.note(bus_messages.PAYLOAD, payload.id, note)
            if payload.id.startswith(NAMELESS) and not payload.alive:
                self._roster.forget(payload)
        refused = ", ".join(sorted(self._roster.refused))
        text = f"no place for {refused[:100]}: payloads.most" if refused else ""
        self._report_once(bus_messages.STATION, "payloads-too-many", text)
        unlisted = ", ".join(self._listener.unlisted())
        text = (
            f"{unlisted[:100]} reaches this station and is not on its list: revoked, or made since"
            " the station's keys were copied here; then copy their folder again"
        )
        self._report_once(bus_messages.STATION, UNLISTED, text if unlisted else "")

    def _elsewhere(self, payload_id: str) -> str:
        """Another station that a payload says it sends its video to; "" for none."""
        state = self._listener.state(payload_id)
        health = state.health if state is not None else None
        return health.ground if health is not None and health.ground != self._listener.name else ""

    def _report_once(self, payload_id: str, name: str, problem: str) -> None:
        """Says a problem once, and once that it is over."""
        key = f"{payload_id} {name}"
        before = self._told.get(key, "")
        if problem == before:
            return
        if len(self._told) >= _TOLD:  # of payloads that came and went
            self._told.clear()
        self._told[key] = problem
        level = bus_messages.WARNING if problem else bus_messages.INFO
        self._event("intake", level, name, problem or "is over", payload_id)

    def _event(self, source: str, level: Level, name: str, text: str, payload_id: str) -> None:
        note = EventMessage(time.time_ns(), source, level, name, text)
        self._publish(bus_messages.EVENT, payload_id, note)
        self.recorder.note(bus_messages.EVENT, payload_id, note)

    def _publish(self, kind: str, payload_id: str, note: Message) -> None:
        with contextlib.suppress(Exception):  # a bus that is gone comes back, or all end
            self._publish_message(kind, payload_id, note)

    def _force_idrs(self) -> None:
        """Asks all that live for an IDR, without waiting for any of them."""

        def ask(payload_id: str) -> None:
            with contextlib.suppress(Exception):
                command.ask(self._listener.session, payload_id, "idr", timeout_s=_IDR_S)

        for payload_id in self._listener.living():
            if self._roster.get(payload_id) is not None:
                threading.Thread(target=ask, args=(payload_id,), name="idr", daemon=True).start()


def _command(request: Mapping[str, Any], session: Session) -> dict[str, Any]:
    payload_id, name = request.get("payload"), request.get("name")
    arguments = request.get("arguments") or {}
    if not isinstance(payload_id, str) or name not in command.NAMES:
        raise InputError(f"command {str(name)[:40]!r}; allowed: {', '.join(command.NAMES)}")
    check_payload_id(payload_id)
    if not isinstance(arguments, dict) or not all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        for value in arguments.values()
    ):
        raise InputError(f"command {name!r}: its arguments must be finite numbers by name")
    numbers = {str(key): float(value) for key, value in arguments.items()}
    answered = command.ask(session, payload_id, name, numbers, _ANSWER_S)
    return {"done": answered.done, "reason": answered.reason, "values": dict(answered.values)}
