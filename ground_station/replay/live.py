"""A live session: from the payload's stream to a pose a frame, every frame accounted for.

What it finds goes back as it comes: poses to the autopilot, reports of the link to the encoder.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ground_station.localization.estimate import PoseEstimate
from ground_station.localization.localizer import Localizer
from ground_station.service.overload import Overload
from ground_station.service.pose_feed import PoseFeed
from ground_station.stream.counters import Counters
from ground_station.stream.feedback import Feedback
from ground_station.stream.receiver import ReceivedFrame, Receiver
from ground_station.stream.telemetry import FrameCounts, PayloadState, TelemetryListener
from pi_firmware.wire import messages
from pi_firmware.wire.clock_offset import Offset
from pi_firmware.wire.errors import StreamError

_POLL_S = 0.1
_DRAIN_S = 2.0
"""After the payload's end-of-stream, packets still on their way come within this."""


@dataclass(frozen=True)
class LiveFrame:
    """One received frame and its estimate; wall-clock nanoseconds.

    `clock_ns` is the payload's clock at capture, `arrival_ns` and `done_ns` are the ground's.
    `offset` is what was known of the payload's clock when the frame was done; None before its
    first answer.
    """

    sequence: int
    clock_ns: int
    arrival_ns: int
    done_ns: int
    estimate: PoseEstimate
    offset: Offset | None = None


@dataclass
class LiveResult:
    """A session's frames and counts.

    `payload` is the payload's own account; `stream` the receiver's. captured = gated + sent +
    discarded, sent = received + lost, and received = localized + not localized + dropped from the
    full queue. `offset` is the newest of the payload's clock; None when it never answered.
    """

    frames: list[LiveFrame] = field(default_factory=list)
    pictures: list[tuple[npt.NDArray[np.uint8], LiveFrame]] = field(default_factory=list)
    payload: FrameCounts | None = None
    stream: Counters = field(default_factory=Counters)
    offset: Offset | None = None
    battery: messages.Battery | None = None
    events: list[messages.Event] = field(default_factory=list)
    complete: bool = False
    """Whether the payload announced the end of its stream, so that its counts are final."""

    def accounts(self) -> dict[str, int]:
        """Frames by what became of them, named as in results.json."""
        sent = self.payload.sent if self.payload else self.stream.decoded
        return {
            "captured": self.payload.captured if self.payload else sent,
            "gated": self.payload.gated if self.payload else 0,
            "discarded": self.payload.discarded if self.payload else 0,
            "sent": sent,
            "received": self.stream.decoded,
            "lost": sent - self.stream.decoded,
            "dropped": self.stream.dropped,
            "localized": sum(frame.estimate.localized for frame in self.frames),
        }

    def latency_ms(self) -> npt.NDArray[np.float64]:
        """Capture to pose of every frame, (N,), milliseconds, both on the ground's clock.

        Of frames that came before the payload's clock had answered by its first answer; if it never
        did (`clock_offset` is None) both clocks are taken for one.
        """
        first = self._first_offset()
        offsets = [frame.offset or first for frame in self.frames]
        captured = [
            offset.to_ours(frame.clock_ns) if offset else frame.clock_ns
            for frame, offset in zip(self.frames, offsets, strict=True)
        ]
        pairs = zip(self.frames, captured, strict=True)
        return np.array([(frame.done_ns - captured_ns) / 1e6 for frame, captured_ns in pairs])

    def clock_offset(self) -> dict[str, int] | None:
        """The payload's clock against ours, as results.json holds it; None when it is not known.

        `offset_ns` is the newest, `uncertainty_ns` the worst that any frame's latency was made
        with, `steps` how often the payload's clock was set meanwhile.
        """
        first = self._first_offset()
        newest = self.offset or first
        if newest is None:
            return None
        used = [frame.offset or first or newest for frame in self.frames] or [newest]
        return {
            "offset_ns": newest.offset_ns,
            "uncertainty_ns": max(offset.uncertainty_ns for offset in used),
            "steps": newest.steps,
        }

    def _first_offset(self) -> Offset | None:
        return next((frame.offset for frame in self.frames if frame.offset), self.offset)


def run(
    receiver: Receiver,
    telemetry: TelemetryListener,
    payload_id: str,
    localizer: Localizer,
    *,
    check: Callable[[], None],
    running: Callable[[], bool],
    start_timeout_s: float,
    on_start: Callable[[int], None] = lambda time_ns: None,
    keep_picture: Callable[[ReceivedFrame], bool] = lambda frame: False,
    on_frame: Callable[[LiveFrame], None] = lambda frame: None,
    repeat: bool = False,
) -> LiveResult:
    """Localizes what comes until the payload ends its stream, and tells the payload the poses.

    `check` raises when the payload has failed, `running` tells whether it may still send,
    `on_start` gets the first frame's capture time before that frame is localized. Frames
    for which `keep_picture` holds keep their image. `repeat` is for a payload that waits for poses:
    while nothing comes it is told the newest again. Raises `StreamError` when no frame came within
    `start_timeout_s`.
    """
    result = LiveResult()
    feed, overload = PoseFeed(telemetry.session), Overload()
    with Feedback(telemetry, {payload_id: receiver}.get):
        for frame in _frames(receiver, telemetry, payload_id, check, running, start_timeout_s):
            if frame is None:
                if repeat:
                    feed.again(payload_id)
                continue
            if not result.frames:
                on_start(frame.time_ns)
            estimate = localizer.process(
                frame.time_ns, frame.image, frame.sequence, frame.exposure_s
            )
            live = LiveFrame(
                frame.sequence,
                frame.clock_ns,
                frame.arrival_ns,
                time.time_ns(),
                estimate,
                telemetry.clock(payload_id),
            )
            overload.watch(
                localizer, time.monotonic(), len(result.frames) + 1, receiver.counters.dropped
            )
            feed.publish(payload_id, estimate, capture_ns=frame.clock_ns, sequence=frame.sequence)
            result.frames.append(live)
            if keep_picture(frame):
                result.pictures.append((frame.image, live))
            on_frame(live)
    final = telemetry.state(payload_id)
    if final is not None:
        result.payload, result.battery, result.events = final.frames, final.battery, final.events
        result.complete = _ended(final) is not None
    result.stream = receiver.counters
    result.offset = telemetry.clock(payload_id)
    return result


def _frames(
    receiver: Receiver,
    telemetry: TelemetryListener,
    payload_id: str,
    check: Callable[[], None],
    running: Callable[[], bool],
    start_timeout_s: float,
) -> Iterator[ReceivedFrame | None]:
    """The frames as they come, until the payload has ended its stream and all of it is here.

    None whenever none has come for a while.
    """
    started_s = last_s = time.monotonic()
    came = False
    while True:
        frame = receiver.get(_POLL_S)
        if frame is not None:
            yield frame
            came, last_s = True, time.monotonic()
            continue
        yield None
        check()
        now_s = time.monotonic()
        ended = _ended(telemetry.state(payload_id))
        if ended is not None and _drained(receiver, ended, now_s - last_s):
            return
        if not running() and now_s - last_s > _DRAIN_S:
            return
        if not came and now_s - started_s > start_timeout_s:
            raise StreamError(f"no video within {start_timeout_s:g} s on UDP port {receiver.port}")


def _ended(state: PayloadState | None) -> FrameCounts | None:
    """The payload's final counts once it has ended its stream."""
    ends = (messages.EVENT_END_OF_STREAM, messages.EVENT_STOPPED)
    if state is None or not any(event.name in ends for event in state.events):
        return None
    return state.frames


def _drained(receiver: Receiver, counts: FrameCounts, idle_s: float) -> bool:
    return receiver.counters.decoded >= counts.sent or idle_s > _DRAIN_S
