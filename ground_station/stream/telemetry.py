"""What the payloads say: battery, health, gate, autopilot, events and life, kept per payload.

Their clocks are followed, and they are served the ground station's time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pi_firmware.wire import credentials, keys, messages
from pi_firmware.wire.clock_offset import ASK_TIMEOUT_S, Clock, Offset, OffsetFilter, ask, serve
from pi_firmware.wire.errors import TelemetryError
from pi_firmware.wire.telemetry import LOCAL_ENDPOINT, open_session

_PERIOD_S = 1.0
_KEPT_CLOCKS = 64


class ClockFollower:
    """Asks each payload for its time once a second, on a thread of its own.

    `known` gives the ids of the payloads that are alive now; `clock` is this machine's wall clock.
    """

    def __init__(self, session: Any, known: Callable[[], list[str]], clock: Clock) -> None:
        self._session = session
        self._known = known
        self._clock = clock
        self._filters: dict[str, OffsetFilter] = {}
        self._offsets: dict[str, Offset] = {}
        self._round_trips_s: dict[str, float | None] = {}
        self._served: dict[str, Any] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clock-follower", daemon=True)
        self._thread.start()

    def offset(self, payload_id: str) -> Offset | None:
        """The newest offset of a payload's clock to ours; None before the first answer."""
        return self._offsets.get(payload_id)

    def round_trip_s(self, payload_id: str) -> float | None:
        """How long the newest question was on its way, there and back.

        Not the shortest, which the offset is made of: this one tells how the link is now. It is at
        least this long where no answer came in time; None where nobody serves the clock.
        """
        return self._round_trips_s.get(payload_id)

    def close(self) -> None:
        """Stops asking; to be called before its session closes."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        wait_s = 0.05  # a payload that comes is asked at once
        while not self._closing.wait(wait_s):
            known = self._known()
            for payload_id in known:
                self._follow(payload_id)
            gone = [payload_id for payload_id in self._served if payload_id not in known]
            for payload_id in gone[: max(0, len(self._served) - _KEPT_CLOCKS)]:
                self._served.pop(payload_id).undeclare()
                for kept in (self._filters, self._offsets, self._round_trips_s):
                    kept.pop(payload_id, None)
            wait_s = _PERIOD_S if known else 0.05

    def _follow(self, payload_id: str) -> None:
        if payload_id not in self._served:
            key = keys.key(payload_id, keys.TIME)
            self._served[payload_id] = serve(self._session, key, self._clock)
        asked_s = time.monotonic()
        trip = ask(self._session, keys.key(payload_id, keys.CLOCK), self._clock)
        if trip is None:
            # A question that reaches nobody ends at once; one that is not answered waits.
            waited_s = time.monotonic() - asked_s
            self._round_trips_s[payload_id] = waited_s if waited_s >= ASK_TIMEOUT_S else None
            return
        if trip.delay_ns >= 0:  # otherwise a clock stepped meanwhile
            self._round_trips_s[payload_id] = trip.delay_ns / 1e9
        offset = self._filters.setdefault(payload_id, OffsetFilter()).add(trip)
        if offset is not None:
            self._offsets[payload_id] = offset


LOCAL_NAME = "local"
"""What a ground station without a certificate is called."""
_KEPT_DECISIONS = 10_000
_KEPT_EVENTS = 200
_KEPT_PAYLOADS = 64


@dataclass(frozen=True)
class FrameCounts:
    """The payload's own account: captured = gated + sent + discarded once its stream has ended.

    `discarded` frames passed the gate and never left the encoder; an older payload tells none.
    """

    captured: int
    gated: int
    heartbeats: int
    sent: int
    discarded: int = 0


_COUNTS = tuple(each.name for each in fields(FrameCounts))


@dataclass
class PayloadState:
    """The latest of what one payload said since it started.

    `decisions` are the gate's by frame sequence number, the newest 10,000 of them. `refused` counts
    messages that were not as agreed.
    """

    payload_id: str
    alive: bool = False
    battery: messages.Battery | None = None
    gate: messages.Gate | None = None
    autopilot: messages.Autopilot | None = None
    health: messages.Health | None = None
    decisions: dict[int, messages.Gate] = field(default_factory=dict)
    events: list[messages.Event] = field(default_factory=list)
    refused: int = 0

    @property
    def frames(self) -> FrameCounts | None:
        """The newest counters, of a gate's message or an event; None before the first."""
        last = self.events[-1] if self.events else None
        if last is not None and (self.gate is None or last.time_ns >= self.gate.time_ns):
            told = last.values
            if {"captured", "gated", "heartbeats", "sent"} <= told.keys():
                return FrameCounts(**{name: told.get(name, 0) for name in _COUNTS})
        if self.gate is None:
            return None
        return FrameCounts(**{name: getattr(self.gate, name) for name in _COUNTS})

    @property
    def ended(self) -> bool:
        """Whether it said that its stream is over."""
        ends = (messages.EVENT_END_OF_STREAM, messages.EVENT_STOPPED)
        return any(event.name in ends for event in self.events)

    @property
    def ssrc(self) -> int | None:
        """The SSRC of the payload's video, which it announces; None before it did."""
        if self.gate is not None:
            return self.gate.ssrc
        return next((e.values["ssrc"] for e in reversed(self.events) if "ssrc" in e.values), None)


class TelemetryListener:
    """Listens to all payloads; a context manager. Its methods can be called from any thread.

    An endpoint `tcp/127.0.0.1:0` takes a free port, which `endpoints` then tells. Raises
    `TelemetryError` with one line when an endpoint is in use. `certificates` is the folder that
    `blimp keys ground` wrote, without which only loopback is spoken to; payloads that look for a
    ground station on the interface `discoverable` find this one. `on_message` is called with the
    payload's id, the key's kind and each message, on a thread of the session. `session` is there
    for what else the ground station says to its payloads; `name` is the ground station's own.
    """

    def __init__(
        self,
        listen: Sequence[str] = (LOCAL_ENDPOINT,),
        *,
        connect: Sequence[str] = (),
        certificates: str | Path = "",
        discoverable: str = "",
        on_message: Callable[[str, str, messages.Message], None] | None = None,
    ) -> None:
        self._states: dict[str, PayloadState] = {}
        self._changed = threading.Condition()
        self._on_message = on_message
        self._held = credentials.load(certificates) if str(certificates) else None
        self.name = self._held.member if self._held else LOCAL_NAME
        self.session = open_session(
            listen=listen, connect=connect, certificates=certificates, discoverable=discoverable
        )
        self.endpoints = self.session.listening
        session = self.session.zenoh
        # One subscriber for all kinds keeps the order in which a payload said things.
        self._subscribers = [
            session.declare_subscriber(keys.every_payload("*"), self._take),
            session.liveliness().declare_subscriber(
                keys.every_payload(keys.ALIVE), self._take_liveliness, history=True
            ),
        ]
        self._clocks = ClockFollower(session, self.living, time.time_ns)

    def __enter__(self) -> TelemetryListener:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def clock(self, payload_id: str) -> Offset | None:
        """How far a payload's clock is from this machine's; None before it answered."""
        return self._clocks.offset(payload_id)

    def round_trip_s(self, payload_id: str) -> float | None:
        """The newest round trip to a payload; None before it answered."""
        return self._clocks.round_trip_s(payload_id)

    def close(self) -> None:
        """Stops listening; what was heard stays readable."""
        self._clocks.close()
        self.session.close()

    def payloads(self) -> list[str]:
        """The ids of all payloads heard of, sorted."""
        with self._changed:
            return sorted(self._states)

    def living(self) -> list[str]:
        """The ids of the payloads that are alive now, sorted."""
        with self._changed:
            return sorted(name for name, state in self._states.items() if state.alive)

    def unlisted(self) -> list[str]:
        """Certificates' names that reach this station and that it does not hear, sorted."""
        return sorted(self.session.linked() - set(self._held.peers)) if self._held else []

    def state(self, payload_id: str) -> PayloadState | None:
        """A snapshot of one payload; None when nothing was heard of it."""
        with self._changed:
            found = self._states.get(payload_id)
            return self._copy(found) if found else None

    def wait(
        self, payload_id: str, condition: Callable[[PayloadState], bool], timeout_s: float
    ) -> PayloadState | None:
        """Waits until a payload's state meets the condition; None when it does not in time."""

        def met() -> bool:
            return payload_id in self._states and condition(self._states[payload_id])

        with self._changed:
            in_time = self._changed.wait_for(met, timeout_s)
            return self._copy(self._states[payload_id]) if in_time else None

    def wait_for_event(self, payload_id: str, name: str, timeout_s: float) -> messages.Event | None:
        """Waits for an event since the payload's start; None when it does not come in time."""
        state = self.wait(payload_id, lambda s: any(e.name == name for e in s.events), timeout_s)
        return next(e for e in reversed(state.events) if e.name == name) if state else None

    @staticmethod
    def _copy(state: PayloadState) -> PayloadState:
        return replace(state, decisions=dict(state.decisions), events=list(state.events))

    def _state_of(self, key_expression: str) -> PayloadState | None:
        """The state a key belongs to, created at the first; call with the lock held.

        It takes the place of the first that is gone where there is none; None where all live.
        """
        payload_id = keys.payload_of(key_expression)
        if payload_id is None:
            return None
        if payload_id not in self._states and len(self._states) >= _KEPT_PAYLOADS:
            gone = next((name for name, state in self._states.items() if not state.alive), None)
            if gone is None:
                return None
            del self._states[gone]
        return self._states.setdefault(payload_id, PayloadState(payload_id))

    def _take(self, sample: Any) -> None:
        key = str(sample.key_expr)
        kind = key.rpartition("/")[2]
        if (of := messages.KINDS.get(kind)) is None:
            return
        message: messages.Message | None = None
        with self._changed:
            state = self._state_of(key)
            if state is None:
                return
            try:
                message = messages.decode(of, sample.payload.to_bytes())
                _keep(state, kind, message)
            except TelemetryError:
                state.refused += 1
            self._changed.notify_all()
        if message is not None and self._on_message is not None:
            self._on_message(state.payload_id, kind, message)

    def _take_liveliness(self, sample: Any) -> None:
        import zenoh

        with self._changed:
            if (state := self._state_of(str(sample.key_expr))) is not None:
                state.alive = sample.kind == zenoh.SampleKind.PUT
            self._changed.notify_all()


def _keep(state: PayloadState, kind: str, message: messages.Message) -> None:
    """Puts a message into its payload's state, whose fields are called as the kinds."""
    if isinstance(message, messages.Event):
        if message.name == messages.EVENT_STARTED:  # a new flight counts from zero
            state.gate, state.health, state.decisions, state.events = None, None, {}, []
        state.events.append(message)
        del state.events[:-_KEPT_EVENTS]
        return
    setattr(state, kind, message)
    if isinstance(message, messages.Gate):
        state.decisions[message.sequence] = message
        if len(state.decisions) > _KEPT_DECISIONS:
            del state.decisions[next(iter(state.decisions))]
