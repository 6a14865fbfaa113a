"""A flight as the ground station saw it: a pose a frame, every frame accounted for."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ground_station.arrays import F64, U8
from ground_station.localization.estimate import PoseEstimate
from ground_station.replay.rig import Running
from ground_station.replay.station import Station
from ground_station.service import bus_messages
from ground_station.service.bus_messages import (
    EstimateMessage,
    EventMessage,
    FrameMessage,
    Message,
    PayloadMessage,
)
from ground_station.service.localizing import derive
from ground_station.service.pictures import PictureReader
from pi_firmware.wire.errors import StreamError

_POLL_S = 0.1
_DRAIN_S = 2.0
"""After the payload's end-of-stream, what is still on its way comes within this."""
_LOCALIZED_S = 60.0
"""And what has come is localized or counted within this, on however busy a machine."""


@dataclass(frozen=True)
class LiveFrame:
    """One received frame and its estimate; wall-clock nanoseconds.

    `clock_ns` is the payload's clock at capture; `arrival_ns` and `done_ns` are the ground's, as is
    `capture_ns`, which is None before the payload's clock has answered.
    """

    sequence: int
    clock_ns: int
    arrival_ns: int
    done_ns: int
    estimate: PoseEstimate
    capture_ns: int | None = None


@dataclass
class LiveResult:
    """A flight's frames and counts.

    `payload` is what the intake told of the payload last, with its own account; captured = gated +
    sent + discarded, sent = received + lost, and received = localized + not localized + dropped,
    which newer frames overtook. `clock` is the newest offset of the payload's clock with the worst
    uncertainty of all; None when it never answered.
    """

    frames: list[LiveFrame] = field(default_factory=list)
    pictures: list[tuple[U8, EstimateMessage]] = field(default_factory=list)
    payload: PayloadMessage = field(default_factory=lambda: PayloadMessage(False, 0))
    clock: dict[str, int] | None = None
    events: list[EventMessage] = field(default_factory=list)
    dropped: int = 0

    @property
    def complete(self) -> bool:
        """Whether the payload announced the end of its stream, so that its counts are final."""
        return self.payload.ended

    def accounts(self) -> dict[str, int]:
        """Frames by what became of them, named as in results.json."""
        told = self.payload.frames
        received = told.get("received", len(self.frames) + self.dropped)
        sent = told.get("sent", received)
        return {
            "captured": told.get("captured", sent),
            "gated": told.get("gated", 0),
            "discarded": told.get("discarded", 0),
            "sent": sent,
            "received": received,
            "lost": sent - received,
            "dropped": self.dropped,
            "localized": sum(frame.estimate.localized for frame in self.frames),
        }

    def captured_ns(self) -> list[int]:
        """When each frame was captured, by the ground's clock.

        Of frames that came before the payload's clock had answered by its first answer; if it never
        did (`clock` is None) both clocks are taken for one.
        """
        known = ((f.capture_ns, f.clock_ns) for f in self.frames if f.capture_ns is not None)
        capture_ns, clock_ns = next(known, (0, 0))
        ahead_ns = capture_ns - clock_ns
        return [
            f.clock_ns + ahead_ns if f.capture_ns is None else f.capture_ns for f in self.frames
        ]

    def latency_ms(self) -> F64:
        """Capture to pose of every frame, (N,), milliseconds."""
        pairs = zip(self.frames, self.captured_ns(), strict=True)
        return np.array([(frame.done_ns - captured_ns) / 1e6 for frame, captured_ns in pairs])


class Inbox:
    """What the bus says of one flight, in the order in which it came."""

    def __init__(
        self, station: Station, payload_id: str, keep_picture: Callable[[int], bool]
    ) -> None:
        self.frames: dict[tuple[int, int], FrameMessage] = {}
        self.pictures: dict[tuple[int, int], U8] = {}
        self._keep, self._reader = keep_picture, PictureReader(station.folder, payload_id)
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        subscribe, put = station.bus.subscribe, self._messages.put
        subscribe(bus_messages.FRAME, FrameMessage, lambda _, said: self._frame(said), payload_id)
        subscribe(bus_messages.ESTIMATE, EstimateMessage, lambda _, said: put(said), payload_id)
        subscribe(bus_messages.PAYLOAD, PayloadMessage, lambda _, said: put(said), payload_id)
        subscribe(bus_messages.EVENT, EventMessage, lambda _, said: put(said), payload_id)

    def _frame(self, message: FrameMessage) -> None:
        if self._keep(message.sequence):  # at once: its place in the ring is soon another's
            image = self._reader.read(message.slot, message.stamp)
            if image is not None:
                self.pictures[message.sequence, message.clock_ns] = image
        self._messages.put(message)

    def take(self, timeout_s: float) -> Message | None:
        """The next message; None when none comes in time."""
        try:
            return self._messages.get(timeout=timeout_s)
        except queue.Empty:
            return None


def run(
    station: Station,
    inbox: Inbox,
    payload: Running,
    *,
    start_timeout_s: float,
    on_first_frame: Callable[[], None] = lambda: None,
    on_frame: Callable[[], None] = lambda: None,
) -> LiveResult:
    """Listens until the payload has ended its stream and all of it is localized.

    Raises `StreamError` when no frame came within `start_timeout_s`, and what `payload` does when
    it has failed.
    """
    result = LiveResult()
    estimates: list[EstimateMessage] = []
    started_s = last_s = ran_s = time.monotonic()
    while True:
        message = inbox.take(_POLL_S)
        now_s = time.monotonic()
        if isinstance(message, FrameMessage):
            if not inbox.frames:
                on_first_frame()
            inbox.frames[message.sequence, message.clock_ns] = message
            last_s = now_s
        elif isinstance(message, EstimateMessage):
            estimates.append(message)
            result.dropped, last_s = message.skipped, now_s
            on_frame()
        elif isinstance(message, EventMessage):
            result.events.append(message)
        elif isinstance(message, PayloadMessage):
            result.payload = message
            if (clock := message.clock) is not None:
                worst_ns = max(clock["uncertainty_ns"], (result.clock or clock)["uncertainty_ns"])
                result.clock = clock | {"uncertainty_ns": worst_ns}
        station.step()
        if message is not None and not isinstance(message, PayloadMessage):
            continue
        payload.check()
        idle_s = now_s - last_s
        if running := payload.running():
            ran_s = now_s
        if result.payload.ended:
            told = result.payload.frames
            taken = len(estimates) + result.dropped
            here = told["received"] >= told.get("sent", 0)  # without its counts: all that came
            all_told = taken >= told["received"]
            if (here and all_told) or idle_s > (_DRAIN_S if all_told else _LOCALIZED_S):
                break
        elif not running and now_s - max(last_s, ran_s) > _DRAIN_S:  # its last words take a moment
            break
        elif not inbox.frames and now_s - started_s > start_timeout_s:
            raise StreamError(
                f"no video within {start_timeout_s:g} s on UDP port {station.video_port}"
            )
    for k, said in enumerate(estimates):
        key = said.sequence, said.clock_ns
        arrival_ns = inbox.frames[key].arrival_ns if key in inbox.frames else said.done_ns
        estimate = derive.estimate_of(said, k)
        result.frames.append(LiveFrame(*key, arrival_ns, said.done_ns, estimate, said.capture_ns))
        if key in inbox.pictures:
            result.pictures.append((inbox.pictures[key], said))
    return result
