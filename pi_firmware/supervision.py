"""The payload watching itself: its tasks, its board and its radio, and what follows for systemd."""

from __future__ import annotations

import contextlib
import gc
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from pi_firmware.autopilot import Autopilot
from pi_firmware.capture import CAMERA, ENCODER, Capture
from pi_firmware.ground import IDR_GAP_S, Ground
from pi_firmware.health.board import Board
from pi_firmware.health.restarts import Restarts
from pi_firmware.health.wifi import Wifi
from pi_firmware.recording import Recorder
from pi_firmware.release import of_environment
from pi_firmware.settings import Settings
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire.clock_offset import OffsetFilter
from pi_firmware.wire.messages import Health
from pi_firmware.wire.systemd import Notifier

VIDEO, BATTERY, AUTOPILOT, HEALTH, CLOCK = "video", "battery", "autopilot", "health", "clock"
MEMORY = "memory"
_REPEAT_S = 60.0  # the same fault is told again after this long, with its count
_JOIN_LIMIT_S = 2.0
_FEED_S = 1.0
_CLOCK_S = 10.0
_MEMORY_S = 60.0
"""CPython puts freed tuples by for later use, up to 2,000 of each length. One that is made longer
than needed and then cut, as `tuple(generator)` and many calls into C do, is taken from one list and
put into another, which fills and is of no use to anybody. Only a full collection empties these
lists, and by itself none came in five minutes of a flight: it waits until what is new is a quarter
of all there is, and a payload in flight makes next to no garbage that has cycles."""
_SILENCE_S = 5.0  # before that a ground station may only be slow
TELEMETRY_UP, TELEMETRY_DOWN, ARMED = "telemetry up", "telemetry down", "autopilot armed"
"""What systemd's status line says; whoever brings or tries out a new release looks for it."""
_GAUGE_PAUSE_S = 35.0  # a gauge that fails is tried again this seldom at most


class Table:
    """When each task was last heard of. Safe from any thread.

    `watchdogs_s`: by a task's name, after how long without a beat it is late. It is watched from
    its first beat, as it begins: one that this flight does without is never late.
    """

    def __init__(
        self, watchdogs_s: Mapping[str, float], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._watchdogs_s = watchdogs_s
        self._clock = clock
        self._lock = threading.Lock()
        self._heard: dict[str, float] = {}

    def beat(self, name: str) -> None:
        """The task begins, or has done its work once more."""
        with self._lock:
            self._heard[name] = self._clock()

    def late(self) -> list[str]:
        """Tasks that began and missed their watchdog since, in the table's order."""
        with self._lock:
            now, heard = self._clock(), self._heard
            return [
                name
                for name, watchdog_s in self._watchdogs_s.items()
                if name in heard and now - heard[name] > watchdog_s
            ]


class PeriodicThread:
    """Runs `call`, a task of the table, every `period_s` on a thread of its own.

    A call that returns is a beat; one that raises is reported as one line and tried again at the
    next period, so that a task that always fails becomes late. The same line is reported once a
    minute at most. Periods that a long call has missed are not made up for.
    """

    def __init__(
        self,
        table: Table,
        name: str,
        period_s: float,
        call: Callable[[], object],
        report: Callable[[str], object],
    ) -> None:
        self._table, self._name, self._period_s = table, name, period_s
        self._call, self._report = call, report
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._last_fault = ""
        self._told_at = 0.0
        self._unsaid = 0

    def start(self) -> None:
        """Starts the thread, whose first call is at once."""
        self._table.beat(self._name)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, waiting no longer than a call that hangs is worth."""
        self._end.set()
        self._thread.join(_JOIN_LIMIT_S)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._end.is_set():
            try:
                self._call()
            except Exception as error:  # whatever it is, a flight does not end for one task
                self._fault(f"{self._name}: {type(error).__name__}: {error}")
            else:
                self._table.beat(self._name)
            now = time.monotonic()
            due = max(due + self._period_s, now)
            self._end.wait(due - now)

    def _fault(self, line: str) -> None:
        line = " ".join(line.split())
        now = time.monotonic()
        if line == self._last_fault and now - self._told_at < _REPEAT_S:
            self._unsaid += 1
            return
        again = f" ({self._unsaid} times more)" if line == self._last_fault and self._unsaid else ""
        self._last_fault, self._told_at, self._unsaid = line, now, 0
        with contextlib.suppress(Exception):  # telling of it may fail, too
            self._report(line + again)


def tasks(settings: Settings) -> dict[str, float]:
    """All that must happen again and again, and when it is late, s.

    `video` beats with each frame that leaves the encoder, `battery` with each believable reading,
    `autopilot` with each of its states.
    """
    camera, battery = settings.camera, settings.battery
    period_s, limit_s = settings.supervision.period_s, settings.supervision.frame_timeout_s
    return {
        VIDEO: limit_s + 1.5 / camera.rate_hz,
        BATTERY: 3 * battery.period_s + _GAUGE_PAUSE_S,
        AUTOPILOT: 3 * settings.autopilot.period_s + 5,
        HEALTH: 3 * period_s + 5,
        CLOCK: 3 * _CLOCK_S,
        MEMORY: 3 * _MEMORY_S,
    }


class Supervision:
    """Publishes health, watches over the tasks, and feeds systemd's watchdog with fresh frames.

    `tend` is called by the main loop; all else runs on threads of its own. `announce` gets an
    event's name and text.
    """

    def __init__(
        self,
        settings: Settings,
        announce: Callable[[str, str], None],
    ) -> None:
        self.table = Table(tasks(settings))
        self.notifier = Notifier()
        self.wifi = Wifi(settings.wifi, announce)
        self.release = of_environment()
        self._settings = settings
        self._restarts = Restarts(settings.supervision.state, settings.supervision.process_restarts)
        folder = settings.recording.folder
        self._board = Board(disk=Path(folder or "/"))
        self._threads: list[PeriodicThread] = []
        self._started_s = time.monotonic()
        self._fed_s = 0.0
        self._ready = False
        self._status = ""
        self._fresh = self._measured = 0
        self._measured_s = self._started_s
        self._clock = OffsetFilter()
        self._ground_offset_s: float | None = None
        self._refusals: set[str] = set()

    def begin(self) -> bool:
        """Counts this process; whether the board is to be rebooted because the last ones failed."""
        self._restarts.begin()
        return self.may_reboot(ending=False)

    def may_reboot(self, *, ending: bool) -> bool:
        """Whether the board is to be rebooted now: as `Restarts.claim_reboot`, if it knows how."""
        knows_how = bool(self._settings.supervision.reboot_command)
        return knows_how and self._restarts.claim_reboot(ending=ending)

    def start(
        self,
        capture: Capture,
        ground: Ground,
        recorder: Recorder,
        telemetry: Telemetry,
        autopilot: Autopilot,
    ) -> None:
        """Starts the threads that publish health, ask for the ground's time and tidy up."""

        def publish() -> None:
            self.wifi.step()
            telemetry.publish(self.health(capture, ground, recorder))
            heard = TELEMETRY_DOWN if ground.seen is None else TELEMETRY_UP
            self._tell_systemd(f"{heard}; {ARMED}" if autopilot.armed else heard)

        def ask() -> None:
            trip = telemetry.ask_time()
            offset = self._clock.add(trip) if trip is not None else None
            self._ground_offset_s = offset.offset_ns / 1e9 if offset else None
            if trip is not None:
                self._refusals.clear()
            elif time.monotonic() - self._started_s > _SILENCE_S:
                self._tell_refusals(telemetry)

        self._threads = [
            PeriodicThread(self.table, name, period_s, call, _complain)
            for name, period_s, call in (
                (HEALTH, self._settings.supervision.period_s, publish),
                (CLOCK, _CLOCK_S, ask),
                (MEMORY, _MEMORY_S, gc.collect),
            )
        ]
        self.table.beat(VIDEO)
        for thread in self._threads:
            thread.start()

    def tend(self, fresh: int) -> None:
        """Takes how many frames left the encoder so far, and feeds the watchdog with new ones."""
        if fresh == self._fresh:
            return
        if not self._ready:  # said again when it was not taken: only then does systemd watch
            self._ready = self.notifier.ready()
        self._restarts.fresh()
        self._fresh = fresh
        self.table.beat(VIDEO)
        now_s = time.monotonic()
        if now_s - self._fed_s >= min(_FEED_S, (self.notifier.watchdog_s or _FEED_S) / 4):
            self._fed_s = now_s
            self.notifier.alive()

    def health(self, capture: Capture, ground: Ground, recorder: Recorder) -> Health:
        """How payload and board are now."""
        now_s, encoded = time.monotonic(), capture.encoded
        span_s = now_s - self._measured_s
        rate_hz = (encoded - self._measured) / span_s if span_s > 0 else 0.0
        self._measured, self._measured_s = encoded, now_s
        counters, seen, wifi = capture.counters, ground.seen, self.wifi.state
        return Health(
            time_ns=time.time_ns(),
            uptime_s=now_s - self._started_s,
            captured=counters.captured,
            gated=counters.gated,
            sent=counters.sent,
            discarded=counters.discarded,
            rate_hz=max(rate_hz, 0.0),
            bitrate_kbps=capture.bitrate_kbps,
            lost=seen.lost if seen else None,
            round_trip_s=seen.round_trip_s if seen else None,
            ground_offset_s=self._ground_offset_s,
            wifi_interface=wifi.interface,
            wifi_signal_dBm=wifi.signal_dBm,
            wifi_quality=wifi.quality,
            wifi_restarts=wifi.restarts,
            camera_restarts=capture.restarts[CAMERA],
            encoder_restarts=capture.restarts[ENCODER],
            process_restarts=self._restarts.process_restarts,
            board_restarts=self._restarts.board_restarts,
            late=self.table.late(),
            recording=recorder.file,
            recording_MB=recorder.size_MB,
            recording_dropped=recorder.dropped,
            version=self.release.version,
            release=self.release.how,
            release_reason=self.release.reason,
            early_reports=True,
            idr_gap_s=IDR_GAP_S,
            ground=ground.followed,
            rtx_ssrc=ground.link.rtx_ssrc,
            correction_ssrc=ground.link.correction_ssrc,
            **asdict(self._board.read()),
        )

    def stop(self) -> None:
        """Ends the threads and tells systemd that the end is in order."""
        self.notifier.stopping()
        for thread in self._threads:
            thread.stop()
        self.wifi.stop()

    def _tell_systemd(self, heard: str) -> None:
        """The status line, once frames have come; said when it changes."""
        status = f"{self.release}; {heard}"
        if self._ready and status != self._status and self.notifier.status(status):
            self._status = status

    def _tell_refusals(self, telemetry: Telemetry) -> None:
        """Who is there and takes no part is told once, until somebody takes part."""
        for line in telemetry.refusals():
            if line not in self._refusals:
                self._refusals.add(line)
                _complain(f"telemetry: {line}")


def _complain(line: str) -> None:
    print(f"pi_firmware: {line}", file=sys.stderr, flush=True)
