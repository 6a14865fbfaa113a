"""Recordings on the payload's own card, of frames and telemetry, which never wait for a disk.

How files get to it is shared with the ground station: `pi_firmware.wire.recorder`.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from pi_firmware.wire import annexb, messages, sei
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recorder import recorder, run
from pi_firmware.wire.recorder.run import Unit

TELEMETRY_ROOT = "/blimp"
_CLOCK_STEP_S = 5.0
_HELD = 256


@dataclass(frozen=True, slots=True)
class Telemetry:
    """A message of one kind, and when it came, by the monotonic clock."""

    kind: str
    message: messages.Message
    arrived_s: float


class FlightRun(run.Run):
    """Takes `Unit` and `Telemetry`; times rise within each of its files."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self._held: deque[Telemetry] = deque()
        self._restart = False
        self._last: Unit | None = None
        self._shift_ns = 0

    def _put(self, item: object) -> None:
        if isinstance(item, Telemetry):
            self._telemetry(item)
        elif isinstance(item, Unit):
            try:
                self._unit(item)
            except Exception:
                self._left_out += 1
                raise

    def _unit(self, unit: Unit) -> None:
        """Into the file of now, or as the first of the next one."""
        if unit.info.time_ns not in run.TIMES_NS:
            self._left_out += 1
            return
        idr = annexb.is_idr(unit.data)
        self._restart = self._restart or self._clock_was_set(unit)
        self._last = unit
        self._shift_ns = unit.info.time_ns - unit.info.clock_ns
        file, limit_bytes = self._current, self._folder.file_limit_bytes
        if not idr:
            if file.size_bytes > limit_bytes + run.OVERRUN_BYTES:
                self._restart = True
            if self._restart or file.size_bytes > limit_bytes:
                self._ask_for_idr()
            if self._restart or not file.begun:
                self._left_out += file.begun  # nothing is missing before the first
                return
        elif file.begun and (self._restart or file.is_full(limit_bytes)):
            self._end_earlier(file)
            self._turn()
            file = self._current
            self._write_held()
        self._restart = self._restart and not idr
        file.unit(unit.info, unit.data, idr=idr)

    def _clock_was_set(self, unit: Unit) -> bool:
        """A file's times rise: readers play it by them."""
        if self._last is None:
            return False
        rises = unit.info.time_ns > self._last.info.time_ns
        return not rises or self._is_of_another_clock(unit.info.time_ns, unit.arrived_s)

    def _is_of_another_clock(self, time_ns: int, arrived_s: float) -> bool:
        """Whether a time lies elsewhere than those of the frames."""
        if self._last is None:
            return False
        expected_ns = self._last.info.time_ns + 1e9 * (arrived_s - self._last.arrived_s)
        return abs(time_ns - expected_ns) > 1e9 * _CLOCK_STEP_S

    def _telemetry(self, item: Telemetry) -> None:
        """With the video's times, where a replay's are not the clock's.

        What was said after the clock was set, before a frame tells of it, waits for the next file.
        """
        time_ns = item.message.time_ns + self._shift_ns
        if self._is_of_another_clock(time_ns, item.arrived_s):
            if len(self._held) == _HELD:
                self._write_held()
            self._held.append(item)
        elif self._current.size_bytes <= self._folder.file_limit_bytes + run.OVERRUN_BYTES:
            self._write_telemetry(item)

    def _write_telemetry(self, item: Telemetry) -> None:
        message, file = item.message, self._current
        time_ns = message.time_ns + self._shift_ns
        if time_ns not in run.TIMES_NS:
            return
        try:
            text, topic = messages.encode(message), f"{TELEMETRY_ROOT}/{item.kind}"
            file.writer.write_json_text(topic, time_ns, text, schema_name=message.SCHEMA)
            file.added(len(text))
        except RecordingError:
            raise
        except Exception:  # not JSON: its sender's error, and no reason to end a recording
            return

    def _before_end(self) -> None:
        self._write_held()

    def _write_held(self) -> None:
        while self._held:
            self._write_telemetry(self._held.popleft())


class Recorder(recorder.Recorder):
    """Records video and telemetry into `recording.folder`, one recording at a time.

    The next file begins at an IDR, without a gap, when one is full or the clock was set. The
    camera's calibration is not in it: the payload does not know it.
    """

    run_type = FlightRun

    def unit(self, info: sei.FrameInfo, access_unit: bytes) -> None:
        """Records an access unit when a recording is made; never waits and never raises."""
        run = self._run
        if run is not None:
            with contextlib.suppress(Exception):
                run.queue.unit(info, access_unit)

    def message(self, kind: str, message: messages.Message) -> None:
        """Records a message on `/blimp/<kind>`, likewise; from any thread."""
        run = self._run
        if run is not None and isinstance(message, messages.Message):
            with contextlib.suppress(Exception):
                run.queue.put(Telemetry(kind, message, time.monotonic()))
