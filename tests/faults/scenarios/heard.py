"""All that is said on the service's bus, with when it was heard here."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    PayloadMessage,
    RecordingMessage,
)

Key = tuple[int, int, int]
"""A frame: its stream's SSRC, its sequence number, the payload's clock at capture."""


def key_of(note: FrameMessage) -> Key:
    """Which frame a note is of."""
    return note.ssrc, note.sequence, note.clock_ns


@dataclass(frozen=True)
class Shown:
    """A frame that the intake gave out."""

    payload_id: str
    key: Key
    time_ns: int
    at_s: float
    run: int  # the service's start
    damaged: bool


@dataclass(frozen=True)
class Told:
    """An estimate: `at` is its frame's place among those of this payload, -1 when it is none."""

    payload_id: str
    note: EstimateMessage
    at: int
    ssrc: int
    at_s: float
    run: int


@dataclass
class Heard:
    """Everything since the first start of the service; safe to read from any thread."""

    shown: dict[str, list[Shown]] = field(default_factory=dict)
    payloads: list[tuple[str, PayloadMessage, float]] = field(default_factory=list)
    recording: list[tuple[RecordingMessage, float]] = field(default_factory=list)
    events: list[tuple[str, EventMessage]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._places: dict[tuple[str, int, int], int] = {}
        self._told: list[tuple[str, EstimateMessage, float, int]] = []
        self._lock = threading.Lock()

    def listen(self, bus: Bus, run: int) -> None:
        """Hears all of a service's start from now on."""
        bus.subscribe(
            bus_messages.FRAME, FrameMessage, lambda who, note: self._frame(who, note, run)
        )
        bus.subscribe(
            bus_messages.ESTIMATE, EstimateMessage, lambda who, note: self._estimate(who, note, run)
        )
        bus.subscribe(
            bus_messages.PAYLOAD,
            PayloadMessage,
            lambda who, note: self.payloads.append((who, note, time.monotonic())),
        )
        bus.subscribe(
            bus_messages.RECORDING,
            RecordingMessage,
            lambda _, note: self.recording.append((note, time.monotonic())),
        )
        bus.subscribe(
            bus_messages.EVENT, EventMessage, lambda who, note: self.events.append((who, note))
        )

    def frames(self, payload_id: str) -> list[Shown]:
        """One payload's frames so far."""
        with self._lock:
            return list(self.shown.get(payload_id, ()))

    def estimates(self) -> list[Told]:
        """All estimates so far, each with its frame, whichever of the two was heard first.

        They come from two processes: on a busy machine a frame's note may be the later one.
        """
        with self._lock:
            return [self._with_frame(*told) for told in self._told]

    def _with_frame(self, payload_id: str, note: EstimateMessage, at_s: float, run: int) -> Told:
        at = self._places.get((payload_id, note.sequence, note.clock_ns), -1)
        ssrc = self.shown[payload_id][at].key[0] if at >= 0 else 0
        return Told(payload_id, note, at, ssrc, at_s, run)

    def payload(self, payload_id: str, since_s: float = 0.0) -> PayloadMessage | None:
        """The newest note of a payload, if it was heard since then."""
        for who, note, at_s in reversed(self.payloads):
            if at_s < since_s:
                return None
            if who == payload_id:
                return note
        return None

    def _frame(self, payload_id: str, note: FrameMessage, run: int) -> None:
        with self._lock:
            shown = self.shown.setdefault(payload_id, [])
            self._places[(payload_id, note.sequence, note.clock_ns)] = len(shown)
            now_s, damaged = time.monotonic(), bool(note.damaged)
            shown.append(Shown(payload_id, key_of(note), note.time_ns, now_s, run, damaged))

    def _estimate(self, payload_id: str, note: EstimateMessage, run: int) -> None:
        with self._lock:
            self._told.append((payload_id, note, time.monotonic(), run))
