"""The payload's state: what is opened, who hears of whom, and the order in which all of it ends."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time

from pi_firmware import encoder, link
from pi_firmware.autopilot import open_autopilot
from pi_firmware.battery import Monitor, open_gauge
from pi_firmware.battery.chip import Gauge
from pi_firmware.capture import Capture, UnrecoverableError
from pi_firmware.commands import Commands, actions
from pi_firmware.gate import Verdict
from pi_firmware.ground import Ground
from pi_firmware.media import Counters, Unit
from pi_firmware.recording import Recorder
from pi_firmware.settings import Settings
from pi_firmware.supervision import AUTOPILOT, BATTERY, Supervision
from pi_firmware.telemetry import Telemetry
from pi_firmware.wire import keys, messages, sei
from pi_firmware.wire.errors import BlimpError, RecordingError, StreamError

_FLUSH_LIMIT_S = 10.0
_COMMAND_LIMIT_S = 30.0
_LOOK_S = 1.0
_RENEWED_S = 10.0
"""A session that was opened again hears the ground station within this."""


class Payload:
    """One flight of the payload: build it, `run` it, `close` it.

    Raises `BlimpError` with one line for whatever cannot be opened.
    """

    def __init__(self, settings: Settings) -> None:
        encoder.require(settings.encoder)
        gauge = open_gauge(settings.battery.uri, settings.battery)
        self.settings = settings
        self.ssrc = link.draw_ssrc(settings.link)
        self.counters = Counters()
        """Those of the capture, once there is one."""
        self._stop = threading.Event()
        self._afterwards: list[str] = []
        self._looks_s, self._renewed = 0.0, False
        self._autopilot = open_autopilot(settings.autopilot, self._tell_autopilot)
        key = link.load_key(settings.telemetry.certificates) if settings.link.encrypted else None
        self._link = link.Link(settings.link, self.ssrc, key)
        self._recorder = Recorder(
            settings.recording,
            self._announce,
            force_idr=lambda: self._capture.force_idr(),
            head={"payload": {"payload_id": settings.payload_id, "camera": settings.camera.uri}},
        )
        self._telemetry = Telemetry(
            settings.payload_id, settings.telemetry, tap=self._recorder.message
        )
        try:
            self._build(gauge)
        except BaseException:  # threads of a session that stays open would keep the process
            self._close_telemetry()
            raise

    def _build(self, gauge: Gauge) -> None:
        settings = self.settings
        announce = self._announce
        self._supervision = Supervision(settings, announce)
        if self._supervision.begin():
            announce(messages.EVENT_FAILED, "no frames from several processes: rebooting the board")
            _run_last(settings.supervision.reboot_command)
            raise UnrecoverableError("no frames from several processes in a row")
        self._capture = Capture(settings, self._tell_gate, self._leave, announce)
        self.counters = self._capture.counters
        self._ground = Ground(
            settings.link,
            self.ssrc,
            self._link,
            self._capture,
            self._telemetry,
            on_heard=self._supervision.wifi.heard,
        )
        self._battery = Monitor(
            settings.battery,
            gauge,
            publish=self._tell_battery,
            announce=announce,
            on_low=self._capture.limit_bitrate,
            on_critical=self._on_critical,
        )
        self._commands = Commands(
            actions(
                settings, self._capture, self._recorder, self._end, lambda: self._autopilot.armed
            ),
            lambda text: self._announce(messages.EVENT_COMMAND, text),
        )

    def run(self, stop: threading.Event) -> None:
        """Flies until the source ends or `stop` is set, then sends what is still inside.

        Raises `BlimpError` when camera, encoder or link fail on the way.
        """
        self._stop = stop
        announce = self._announce
        started = f"streaming {self.settings.camera.uri}, {self._supervision.release}"
        announce(messages.EVENT_STARTED, started)
        try:
            self._link.start()
            self._capture.start()
            self._supervision.start(
                self._capture, self._ground, self._recorder, self._telemetry, self._autopilot
            )
            self._battery.start()
            self._autopilot.start()
            self._telemetry.on(keys.POSE, messages.Pose, self._on_pose)
            self._telemetry.on(keys.LINK, messages.LinkReport, self._ground.heard)
            self._telemetry.on_command(self._commands.ask)
            self._fly(stop)
        except BlimpError as error:
            announce(messages.EVENT_FAILED, str(error))
            if isinstance(error, UnrecoverableError) and self._supervision.may_reboot(ending=True):
                self._afterwards = self.settings.supervision.reboot_command
            raise
        if self.cut_reason:
            announce(messages.EVENT_SOURCE_CUT, self.cut_reason)
        self._battery.stop()  # what ended the flight is told before its end
        name = messages.EVENT_STOPPED if stop.is_set() else messages.EVENT_END_OF_STREAM
        announce(name, str(self.counters))

    @property
    def cut_reason(self) -> str:
        return self._capture.cut_reason

    @property
    def listening(self) -> tuple[str, ...]:
        return self._telemetry.listening

    def close(self) -> None:
        """Stops everything and releases it; then runs what was asked for after the end."""
        self._supervision.stop()
        self._recorder.close()  # before all that might hang: what is recorded is on the card
        with contextlib.suppress(UnrecoverableError):  # what hangs ends with the process
            self._capture.close()
        self._commands.close()
        self._autopilot.stop()
        self._battery.stop()
        self._close_telemetry()
        _run_last(self._afterwards)

    def _close_telemetry(self) -> None:
        self._link.stop()
        self._telemetry.close()

    def _fly(self, stop: threading.Event) -> None:
        flush_until: float | None = None
        record = self.settings.recording.at_start
        while self._capture.step():
            if record and self._capture.encoded:  # what a recorder needs is not loaded before
                record = False
                threading.Thread(target=self._record_at_start, name="record", daemon=True).start()
            self._supervision.tend(self._fresh_frames())
            self._look_for_ground()
            if failure := self._link.failure():
                raise StreamError(f"video link: {failure}")
            if stop.is_set() and flush_until is None:
                self._capture.end()
                flush_until = time.monotonic() + _FLUSH_LIMIT_S
            if flush_until is not None and time.monotonic() > flush_until:
                raise StreamError(f"the encoder did not end within {_FLUSH_LIMIT_S:g} s")
        self._link.flush()

    def _look_for_ground(self) -> None:
        """A radio that came late, or has a new address, is not looked on by the session we have.

        The ground station of before is tried again; another one is found by another process only.
        """
        now_s = time.monotonic()
        if now_s < self._looks_s or self.settings.telemetry.discover == "":
            return
        self._looks_s = now_s + _LOOK_S
        if not self._telemetry.outdated or self._ground.seen is not None:
            self._renewed = False
        elif not self._renewed and self._telemetry.renew():
            self._renewed, self._looks_s = True, now_s + _RENEWED_S
        else:
            raise UnrecoverableError("telemetry.discover: the interface has another address by now")

    def _leave(self, unit: Unit) -> bool:
        """On the encoder's thread: a finished frame's way out."""
        self._recorder.unit(unit.info, unit.data)
        return self._link.send(unit.data, unit.clock_ns, idr=unit.idr)

    def _fresh_frames(self) -> int:
        """Frames that left the encoder; without heartbeats those that the gate judged are fresh."""
        if self.settings.gate.heartbeat_s == 0:
            return self.counters.captured
        return self._capture.encoded

    def _tell_gate(self, info: sei.FrameInfo, verdict: Verdict) -> None:
        """The gate's decision on a frame."""
        self._telemetry.publish(
            messages.Gate(
                time_ns=time.time_ns(),
                capture_ns=info.time_ns,
                sequence=info.sequence,
                passed=verdict.passed,
                heartbeat=info.heartbeat,
                entropy_bits=info.entropy_bits,
                sharpness=info.sharpness,
                ssrc=self.ssrc,
                reason=verdict.reason,
                difference=verdict.difference,
                **vars(self.counters),
            )
        )

    def _announce(self, name: str, text: str) -> None:
        """An event, with the counters and the stream's properties; from any thread."""
        camera = self.settings.camera
        values = {
            "ssrc": self.ssrc,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            **vars(self.counters),
        }
        self._telemetry.publish(
            messages.Event(time_ns=time.time_ns(), name=name, text=text, values=values)
        )

    def _tell_battery(self, message: messages.Battery) -> None:
        self._supervision.table.beat(BATTERY)
        self._telemetry.publish(message)

    def _tell_autopilot(self, message: messages.Autopilot) -> None:
        self._supervision.table.beat(AUTOPILOT)
        self._telemetry.publish(message)

    def _on_pose(self, message: messages.Pose) -> None:
        self._capture.answered(message.sequence)
        self._autopilot.on_pose(message)

    def _on_critical(self) -> None:
        """On the battery's thread: the recording ends at once, whatever the flight's end takes."""
        self._end(self.settings.battery.shutdown_command)
        self._recorder.close()

    def _end(self, command: list[str]) -> None:
        self._afterwards = command
        self._stop.set()

    def _record_at_start(self) -> None:
        """A card that takes no recording ends no flight."""
        try:
            self._recorder.start()
        except RecordingError as error:
            self._announce(messages.EVENT_RECORDING_ENDED, str(error))


def _run_last(command: list[str]) -> None:
    """Runs what ends or reboots the board, if anything does."""
    if not command:
        return
    try:
        subprocess.run(command, timeout=_COMMAND_LIMIT_S, check=True, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError) as error:
        print(f"pi_firmware: {command[0]}: {error}", file=sys.stderr)
