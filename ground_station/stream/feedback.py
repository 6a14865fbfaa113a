"""What the ground station says back of the video: once a second, to each payload that lives.

And at once when a loss keeps frames from being shown: the next IDR then comes after a round trip
and not at the end of its interval. And five times a second while the link has a queue or overflows.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from ground_station.stream.arrivals import Flow
from ground_station.stream.counters import Counters
from ground_station.stream.multi_stream import Stream
from ground_station.stream.telemetry import PayloadState, TelemetryListener
from pi_firmware.wire import keys, messages

PERIOD_S = 1.0
_LOOK_S = 0.004
"""A frame of 30 Hz has 33 ms: what is lost in one is to be asked for before the next is encoded."""
_IDR_GAP_S = 0.1
"""What an older payload leaves between two IDRs, and how long one is awaited."""
_JITTER_S = 0.01
"""A wish that comes to a payload by so much sooner than it left after the one before is heard."""
WINDOW_S = 2.0
EARLY_S = 0.2
_EARLY_LOOK_S = 0.04
_EARLY_QUEUE_S = 0.03
_EARLY_DROPPED = 0.1


@dataclass(frozen=True)
class Awaited:
    """For a `Stream` of which nothing came yet: its payload must hear where to send."""

    port: int
    ssrc: None = None
    counters: Counters = field(default_factory=Counters)

    def flow(self) -> None:
        """Nothing comes."""

    def retransmits(self, rtx_ssrc: int | None, round_trip_s: float | None) -> None:
        """Nothing is asked for."""

    def corrects(self, ssrc: int | None) -> None:
        """Nothing is corrected."""


Video = Stream | Awaited


@dataclass(frozen=True)
class Tally:
    """Packets of one stream: those in time, each once, and those the decoder went on without.

    A packet that comes late was given up before and stays lost; a duplicate counts once. So both
    together are the packets that were sent. `frames` is how many the payload says it sent,
    `recovered` those of the packets in time that had to be sent again, `corrected` those that were
    found, and `again` what came again at all.
    """

    packets: int = 0
    lost: int = 0
    frames: int = 0
    recovered: int = 0
    corrected: int = 0
    again: int = 0

    def __sub__(self, other: Tally) -> Tally:
        before = vars(other)
        return Tally(**{name: max(0, now - before[name]) for name, now in vars(self).items()})

    @property
    def share_lost(self) -> float:
        """0 to 1; 1 when frames were sent and nothing at all came, 0 when nothing was sent."""
        if self.packets + self.lost:
            return self.lost / (self.packets + self.lost)
        # Of a single frame the word may be here before its packets.
        return 1.0 if self.frames > 1 else 0.0

    @property
    def share_missed(self) -> float:
        """The same of what was lost before it was recovered."""
        if self.packets + self.lost:
            missed = self.lost + self.recovered + self.corrected
            return missed / (self.packets + self.lost)
        return self.share_lost


class StreamAccount:
    """What became of a payload's packets, by the counters of the stream that it has."""

    def __init__(self) -> None:
        self._ssrc: int | None = None
        self._packets = 0
        self._window: deque[tuple[float, Tally]] = deque()
        self.late = Tally()
        """Of the last 2 s, or what is known of them."""

    def add(self, ssrc: int, counters: Counters, frames: int, now_s: float) -> tuple[Tally, float]:
        """The stream's tally so far, and the share lost over the last 2 s or what is known of them.

        `now_s` is of a clock that never steps.
        """
        if ssrc != self._ssrc or counters.packets < self._packets:  # another, or counted again
            self._window.clear()
        self._ssrc, self._packets = ssrc, counters.packets
        tally = _tally(counters, frames)
        while len(self._window) > 1 and now_s - self._window[1][0] >= WINDOW_S:
            self._window.popleft()
        since = self._window[0][1] if self._window else Tally(frames=frames)
        if frames < since.frames:  # the payload counts again
            self._window.clear()
        self._window.append((now_s, tally))
        self.late = tally - since
        return tally, self.late.share_lost


class Urgency:
    """When a payload is to hear of its stream before the second is over; on a clock of seconds.

    While the link has a queue or overflows, and once more when that is over.
    """

    def __init__(self) -> None:
        self._told_s = self._looked_s = float("-inf")
        self._was_urgent = False

    def wants_look(self, now_s: float) -> bool:
        """Whether the flow is worth looking at again."""
        if now_s - self._told_s < EARLY_S or now_s - self._looked_s < _EARLY_LOOK_S:
            return False
        self._looked_s = now_s
        return True

    def is_due(self, flow: Flow | None) -> bool:
        """Whether a report must not wait."""
        return self._was_urgent or _is_urgent(flow)

    def reported(self, report: messages.LinkReport, now_s: float) -> None:
        """This report went out; a wish for an IDR is none of the link."""
        if not report.wants_idr:
            self._told_s, self._was_urgent = now_s, _is_urgent(report)


def _is_urgent(seen: Flow | messages.LinkReport | None) -> bool:
    if seen is None:
        return False
    return (seen.queue_s or 0.0) > _EARLY_QUEUE_S or (seen.dropped or 0.0) > _EARLY_DROPPED


def _tally(counters: Counters, frames: int) -> Tally:
    recovered, corrected = counters.packets_recovered, counters.packets_corrected
    in_time = counters.packets - counters.packets_late + recovered + corrected
    again = counters.retransmissions
    return Tally(in_time, counters.packets_lost, frames, recovered, corrected, again)


@dataclass
class _Short:
    """Frames of a payload that an IDR was asked for, IDRs that had come by then, and when."""

    frames: int
    idrs: int
    asked_s: float = float("-inf")


class Feedback:
    """Publishes a `messages.LinkReport` a second to each living payload; a context manager.

    `video_of` gives a payload's stream, or None for one whose video is not taken here: it gets no
    report. To be closed before its listener.
    """

    def __init__(
        self,
        listener: TelemetryListener,
        video_of: Callable[[str], Video | None],
        *,
        period_s: float = PERIOD_S,
    ) -> None:
        self._listener = listener
        self._video_of = video_of
        self._period_s = period_s
        self._accounts: dict[str, StreamAccount] = {}
        self._short: dict[str, _Short] = {}
        self._urgencies: dict[str, Urgency] = {}
        self._publishers: dict[str, Any] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feedback", daemon=True)
        self._thread.start()

    def __enter__(self) -> Feedback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops reporting; a second call does nothing."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        import zenoh

        due_s = time.monotonic() + self._period_s
        while not self._closing.wait(min(_LOOK_S, self._period_s)):
            now_s = time.monotonic()
            is_due = now_s >= due_s
            if is_due:
                due_s = max(due_s + self._period_s, now_s)
            for payload_id in self._listener.living():
                video = self._video_of(payload_id)
                if video is None:
                    continue
                wants_idr = self._wants_idr(payload_id, video, now_s)
                is_early = self._is_early(payload_id, video, now_s)
                # A link that just went takes no report; the next one may be back.
                with contextlib.suppress(zenoh.ZError):
                    if is_due or is_early:
                        self._publish(payload_id, self._report(payload_id, video))
                    if wants_idr:
                        wish = replace(self._report(payload_id, video), wants_idr=True)
                        self._publish(payload_id, wish)

    def _is_early(self, payload_id: str, video: Video, now_s: float) -> bool:
        """Whether a report must not wait, to a payload that does not take it for a second's."""
        urgency = self._urgencies.setdefault(payload_id, Urgency())
        if not (urgency.wants_look(now_s) and urgency.is_due(video.flow())):
            return False
        state = self._listener.state(payload_id)
        return state is not None and state.health is not None and state.health.early_reports

    def _wants_idr(self, payload_id: str, video: Video, now_s: float) -> bool:
        """Whether frames came since the last look that only an IDR lets be shown again.

        Whole again, that is. Those that wait for what was asked for again are not among them. The
        next wish waits until the IDR of the one before has come, or must have been lost.
        """
        counters = video.counters
        frames = counters.withheld + counters.damaged
        short = self._short.setdefault(payload_id, _Short(frames, counters.idrs))
        if frames < short.frames:  # another receiver
            short.frames, short.idrs = frames, counters.idrs
        gap_s = _IDR_GAP_S
        if counters.idrs > short.idrs:
            state = self._listener.state(payload_id)
            if state is not None and state.health is not None:
                gap_s = min(gap_s, state.health.idr_gap_s)
        if frames == short.frames or now_s - short.asked_s < gap_s + _JITTER_S:
            return False
        self._short[payload_id] = _Short(frames, counters.idrs, now_s)
        return True

    def _report(self, payload_id: str, video: Video) -> messages.LinkReport:
        state = self._listener.state(payload_id)
        ssrc, counters = video.ssrc, video.counters
        round_trip_s = self._listener.round_trip_s(payload_id)
        if ssrc is not None and _is_anothers(ssrc, state):
            ssrc = None
        tally, lost, missed, flow = Tally(), 0.0, 0.0, None
        if ssrc is not None:
            flow = video.flow()
            health = state.health if state is not None else None
            video.retransmits(health.rtx_ssrc if health is not None else None, round_trip_s)
            video.corrects(health.correction_ssrc if health is not None else None)
            frames = state.frames if state is not None else None
            account = self._accounts.setdefault(payload_id, StreamAccount())
            sent = frames.sent if frames is not None else 0
            tally, lost = account.add(ssrc, counters, sent, time.monotonic())
            missed = account.late.share_missed
        return messages.LinkReport(
            time_ns=time.time_ns(),
            ground=self._listener.name,
            video_port=video.port,
            ssrc=ssrc,
            packets=tally.packets,
            packets_lost=tally.lost,
            lost=lost,
            round_trip_s=round_trip_s,
            packets_recovered=tally.recovered,
            missed=missed,
            corrects=True,
            packets_corrected=tally.corrected,
            answered=tally.again,
            **(vars(flow) if flow is not None else {}),
        )

    def _publish(self, payload_id: str, report: messages.LinkReport) -> None:
        import zenoh

        if payload_id not in self._publishers:
            self._publishers[payload_id] = self._listener.session.zenoh.declare_publisher(
                keys.key(payload_id, keys.LINK), congestion_control=zenoh.CongestionControl.DROP
            )
        self._publishers[payload_id].put(messages.encode(report))
        self._urgencies.setdefault(payload_id, Urgency()).reported(report, time.monotonic())


def _is_anothers(ssrc: int, state: PayloadState | None) -> bool:
    """Whether the payload announced another stream than this one."""
    announced = state.ssrc if state is not None else None
    return announced is not None and announced != ssrc
