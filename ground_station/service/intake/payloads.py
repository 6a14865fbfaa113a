"""What is known of one payload: its frames on their way in, and its account."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from ground_station.service import bus_messages
from ground_station.service.bus_messages import FrameMessage, Message, PayloadMessage
from ground_station.service.intake.recording import GroundRecorder
from ground_station.service.pictures import PictureWriter, packed
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.feedback import StreamAccount
from ground_station.stream.multi_stream import Stream
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware.wire import messages
from pi_firmware.wire.clock_offset import Offset

Publish = Callable[[str, str, Message], None]

_WINDOW_S = 2.0
_FRESH_S = 3.0
"""A payload whose telemetry is gone lives as long as its frames come."""
_RESTART_S = 0.5
"""A payload that restarts is silent for at least so long."""
_LATE_NS, _EARLY_NS = 10_000_000_000, 1_000_000_000
"""A capture that would lie so long before its arrival, or after it: a clock was just set."""


class Payload:
    """One payload that is taken up. `take` is called on its stream's thread, `note` on another."""

    def __init__(
        self, payload_id: str, folder: Path | None, publish: Publish, recorder: GroundRecorder
    ) -> None:
        self.id = payload_id
        self.alive = False
        self.seen_ns = 0
        self.station = ""
        """Another one, to which it says that it sends its video."""
        self.stream: Stream | None = None
        """The newest; it may have ended."""
        self.clock: Callable[[], Offset | None] = lambda: None
        self.started_ns = 0
        """When a session starts, by the payload's own clock: its word may be heard after frames."""
        self._publish, self._recorder = publish, recorder
        self._pictures = PictureWriter(folder, payload_id) if folder is not None else None
        self._lock = threading.Lock()  # two streams overlap for a moment when it restarts
        self._frame_s, self._clock_ns = float("-inf"), 0
        self._first: tuple[int, int, int] | None = None
        self.last_sequence = -1
        self._base = Counters()
        """Of the stream, before the payload's newest session: one may keep its SSRC."""
        self._before: int | None = None
        self._dropped = self._shown = 0
        self._samples: deque[tuple[float, int, int]] = deque()
        self._account = StreamAccount()

    def take(self, frame: ReceivedFrame) -> None:
        """Puts a frame where it is seen, says so, and records it."""
        offset = self.clock()
        capture_ns = None if offset is None else offset.to_ours(frame.clock_ns)
        if capture_ns is not None and not (-_LATE_NS < capture_ns - frame.arrival_ns < _EARLY_NS):
            capture_ns = None
        with self._lock:
            now_s = time.monotonic()
            silent_s = now_s - self._frame_s
            self.seen_ns = frame.arrival_ns
            if self._first is None or self._first[0] != frame.ssrc:
                units = self.stream.counters.access_units if self.stream else 1
                self._first = (frame.ssrc, frame.sequence, units)
                self._shown = 0
            elif self._began_anew(frame, silent_s) and self.stream is not None:
                counters = self.stream.counters
                fate = "decoded" if frame.damaged is None else "damaged"
                before = {name: getattr(counters, name) - 1 for name in ("access_units", fate)}
                self._base = dataclasses.replace(counters, **before)
                self._first = (frame.ssrc, frame.sequence, 1)
                self._before, self._dropped, self._shown = None, 0, 0
            self._frame_s, self._clock_ns = now_s, frame.clock_ns
            self.last_sequence = frame.sequence
            self._show(frame, capture_ns)
        log_ns = frame.arrival_ns if capture_ns is None else capture_ns
        self._recorder.frame(self.id, frame, log_ns)

    def _began_anew(self, frame: ReceivedFrame, silent_s: float) -> bool:
        """Whether a frame is the first of a session.

        Its number tells, but where as many were lost at the start as the session before had: there
        its word does, in the silence between the two.
        """
        said = self._clock_ns < self.started_ns <= frame.clock_ns and silent_s > _RESTART_S
        return said or frame.sequence <= self.last_sequence

    def _show(self, frame: ReceivedFrame, capture_ns: int | None) -> None:
        if self._pictures is None:
            return
        try:
            slot, stamp = self._pictures.write(frame.image)
        except OSError:  # the run's folder is full
            self._dropped += 1
            return
        self._shown += 1
        height, width = frame.image.shape[:2]
        note = FrameMessage(
            slot=slot,
            stamp=stamp,
            arrival_ns=frame.arrival_ns,
            width_px=width,
            height_px=height,
            ssrc=frame.ssrc,
            capture_ns=capture_ns,
            shown=self._shown,
            damaged=packed(frame.damaged),
            **vars(frame.info),
        )
        self._publish(bus_messages.FRAME, self.id, note)

    @property
    def streaming(self) -> bool:
        """Whether frames came of late."""
        return time.monotonic() - self._frame_s < _FRESH_S

    def follow(self, stream: Stream | None) -> bool:
        """Takes note of its stream; whether it is another than before."""
        if stream is None or stream is self.stream:
            return False
        with self._lock:
            new = self.stream is None or stream.ssrc != self.stream.ssrc
            self.stream = stream
            if new:
                self._base = Counters()
                self._before, self._dropped = None, 0
                self._samples.clear()
        return new

    def note(
        self, state: PayloadState | None, listener: TelemetryListener, *, encrypted: bool
    ) -> PayloadMessage:
        """How it is, for all who want to know."""
        stream, now_s = self.stream, time.monotonic()
        counters = stream.counters if stream is not None else Counters()
        rate_hz, kbps = self._rates(now_s, counters.received, stream.bytes if stream else 0)
        sent = state.frames.sent if state is not None and state.frames is not None else 0
        lost_share = 0.0
        if stream is not None:
            _, lost_share = self._account.add(stream.ssrc, counters, sent, now_s)
        offset = listener.clock(self.id)
        health = state.health if state is not None else None
        followed = health.ground if health is not None else ""
        self.station = followed if followed != listener.name else ""
        return PayloadMessage(
            alive=self.alive,
            seen_ns=self.seen_ns,
            ssrc=stream.ssrc if stream is not None else None,
            encrypted=encrypted,
            frames=self._frames(state, counters),
            stream=dataclasses.asdict(counters),
            rate_hz=round(rate_hz, 2),
            bitrate_kbps=round(kbps, 1),
            lost_share=lost_share,
            clock=None if offset is None else dataclasses.asdict(offset),
            round_trip_s=listener.round_trip_s(self.id),
            battery=state.battery if state else None,
            health=health,
            autopilot=state.autopilot if state else None,
            recording=health.recording if health is not None else "",
            refused=state.refused if state is not None else 0,
            ended=state is not None and state.ended,
            station=self.station,
        )

    def close(self) -> None:
        """Removes its pictures."""
        if self._pictures is not None:
            with self._lock, contextlib.suppress(OSError):
                self._pictures.close()

    def _rates(self, now_s: float, received: int, received_bytes: int) -> tuple[float, float]:
        """Frames a second and kbit/s, of late."""
        samples = self._samples
        samples.append((now_s, received, received_bytes))
        while len(samples) > 2 and now_s - samples[1][0] >= _WINDOW_S:
            samples.popleft()
        then_s, frames, size = samples[0]
        span_s = now_s - then_s
        if span_s <= 0:
            return 0.0, 0.0
        return (received - frames) / span_s, (received_bytes - size) * 8e-3 / span_s

    def _frames(self, state: PayloadState | None, counters: Counters) -> dict[str, int]:
        """Frames by fate, since this session was first seen: sent = received + withheld + lost.

        Of those received, some are damaged.

        What was sent before that is none of the lost: the payload's own account is told as it is.
        """
        base = self._base  # a frame's thread may have set it after these counters were read
        result = {
            "received": max(0, counters.received - base.received),
            "damaged": max(0, counters.damaged - base.damaged),
            "lost": 0,
            "withheld": max(0, _withheld(counters) - _withheld(base)),
            "dropped": self._dropped,
        }
        said = state.frames if state is not None else None
        if state is None or said is None:
            return result
        result |= {
            "captured": said.captured,
            "gated": said.gated,
            "sent": said.sent,
            "discarded": said.discarded,
        }
        if self._before is None:
            self._before = self._sent_before(state)
        arrived = counters.access_units - base.access_units + (self._before or 0)
        result["lost"] = max(0, said.sent - arrived) if self._before is not None else 0
        return result

    def _sent_before(self, state: PayloadState) -> int | None:
        """Frames of this stream that were sent before anything of it was awaited here."""
        if any(event.name == messages.EVENT_STARTED for event in state.events):
            return 0  # we were there from its start
        if self._first is None or self.stream is None or self._first[0] != self.stream.ssrc:
            return None
        _, sequence, units = self._first
        gate = state.decisions.get(sequence)
        if gate is None:
            return None
        return max(0, gate.captured - gate.gated - gate.discarded - units)


def _withheld(counters: Counters) -> int:
    """Frames that came and cannot be shown."""
    return counters.withheld + counters.failed + counters.unstamped
