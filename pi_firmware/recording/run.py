"""One recording from start to stop: a thread that writes files, one after the other."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from pi_firmware.recording.file import CHUNK_BYTES, HEAD_BYTES, FlightFile, OpenFile
from pi_firmware.recording.folder import Folder
from pi_firmware.recording.intake import Intake, Telemetry, Unit
from pi_firmware.settings import RecordingSettings
from pi_firmware.wire import annexb
from pi_firmware.wire.errors import RecordingError

QUEUE_BYTES = 8_000_000
"""What may wait for the disk: half a minute at 2 Mbit/s."""

_SYNC_SHARE = 0.75
"""Of `sync_s`, from one sync to the next: the rest is the card's, to take what was handed to it."""

_DRAIN_LIMIT_S = 3.0
"""How long an end waits for a slow disk to take what is queued."""

_CLOCK_STEP_S = 5.0
_IDR_PERIOD_S = 1.0
_HELD = 256
_OVERRUN_BYTES = 8_000_000
_TIMES_NS = range(1 << 63)
"""What MCAP and its readers take."""


class Run:
    """Writes what `intake` is given until `end`, or until the disk takes no more.

    `told` is called on the thread with True and a text for a file that goes on from another, and
    once with False and how much there is when all has ended, and why unless `end` was called.
    """

    def __init__(
        self,
        settings: RecordingSettings,
        *,
        told: Callable[[bool, str], None],
        force_idr: Callable[[], object],
        payload: Mapping[str, str],
        open_file: OpenFile,
    ) -> None:
        self.intake = Intake(QUEUE_BYTES, CHUNK_BYTES)
        self.name = ""
        self.size_bytes = 0
        """Of the file `name`."""
        self._settings = settings
        self._told, self._force_idr = told, force_idr
        self._payload = dict(payload)
        self._open_file = open_file
        self._folder = Folder(settings)
        self._file: FlightFile | None = None
        self._first = ""
        self._part = 0
        self._frames = 0  # in earlier files
        self._held: deque[Telemetry] = deque()
        self._given_up = False
        self._left_out = 0
        self._restart = False
        self._last: Unit | None = None
        self._shift_ns = 0
        self._asked_s = float("-inf")
        self._refused: str | None = None
        self._opened, self._closed = threading.Event(), threading.Event()
        self._go = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def left_out(self) -> int:
        """Frames that are in no file since it began to record: the disk was slow or broke, or the
        clock was set and the frames up to the next IDR belong to neither file."""
        return self._left_out + self.intake.left_out

    def begin(self, limit_s: float) -> None:
        """Opens the first file; raises `RecordingError` with one line when that is not possible."""
        self._thread.start()
        if not self._opened.wait(limit_s):
            self.give_up()
            raise RecordingError(
                f"recording.folder '{self._folder.path}': no answer within {limit_s:g} s"
            )
        if self._refused is not None:
            self._thread.join()
            raise RecordingError(self._refused)

    def go(self) -> None:
        """Lets it write: whoever began it is ready for its end."""
        self._go.set()

    def end(self, limit_s: float) -> bool:
        """Ends the file; whether that was done within the limit.

        What `told` does of it may take as long again, at most.
        """
        self.intake.close()
        done = self._closed.wait(limit_s)
        if done:
            self._thread.join(limit_s)
        return done

    def give_up(self) -> None:
        """Ends it without waiting, and tells nothing of it any more."""
        self._given_up = True
        self.intake.close()
        self._go.set()

    def is_alive(self) -> bool:
        """Whether its thread still runs: it hangs on a disk when `end` was not done."""
        return self._thread.is_alive()

    def _run(self) -> None:
        reason: str | None = None
        try:
            self._file = self._next_file()
            self._opened.set()
            self._go.wait()
            self._write()
        except RecordingError as error:
            reason = str(error)
        except Exception as error:  # whatever it is, a flight does not end for its recording
            reason = f"{type(error).__name__}: {error}"
        self.intake.close()
        self.intake.clear()
        if self._file is None:
            self._refused = reason
            self._opened.set()
            return
        try:
            self._end_file(reason or "")
        except Exception as error:
            reason = reason or str(error)
        self._left_out += self._file.frames - self._file.kept
        self._closed.set()
        if not self._given_up:
            self._told(False, self._told_at_end(reason))

    def _told_at_end(self, reason: str | None) -> str:
        names = self.name if self.name == self._first else f"{self._first} to {self.name}"
        text = f"{names}: {self._frames + self._current.kept} frames"
        return f"{text}; {reason}" if reason else text

    def _write(self) -> None:
        period_s = _SYNC_SHARE * self._settings.sync_s
        due_s = wake_s = time.monotonic() + period_s
        last_s = math.inf
        while True:
            ending = self.intake.wait(wake_s)
            now_s = time.monotonic()
            if ending:
                last_s = min(last_s, now_s + _DRAIN_LIMIT_S)
            pause_s = min(now_s + period_s, last_s)  # however much waits, it is synced between
            while (item := self.intake.take()) is not None:
                self._put(item)
                if time.monotonic() >= pause_s:
                    break
            now_s = time.monotonic()
            if ending and (item is None or now_s >= last_s):
                self._say_what_waited()
                return
            if now_s >= due_s:
                due_s = now_s + period_s
                self._flush()
                self._current.sync()
            wake_s = due_s if item is None else now_s

    def _put(self, item: Unit | Telemetry) -> None:
        if isinstance(item, Telemetry):
            self._telemetry(item)
        else:
            try:
                self._unit(item)
            except Exception:
                self._left_out += 1
                raise
        self.size_bytes = self._current.size_bytes
        if self._current.pending_bytes >= CHUNK_BYTES:
            self._flush()

    @property
    def _current(self) -> FlightFile:
        assert self._file is not None
        return self._file

    def _unit(self, unit: Unit) -> None:
        """Into the file of now, or as the first of the next one."""
        if unit.info.time_ns not in _TIMES_NS:
            self._left_out += 1
            return
        idr = annexb.is_idr(unit.data)
        self._restart = self._restart or self._clock_was_set(unit)
        self._last = unit
        self._shift_ns = unit.info.time_ns - unit.info.clock_ns
        file, limit_bytes = self._current, self._folder.file_limit_bytes
        if not idr:
            if file.size_bytes > limit_bytes + _OVERRUN_BYTES:
                self._restart = True
            if self._restart or file.size_bytes > limit_bytes:
                self._ask_for_idr()
            if self._restart or not file.begun:
                self._left_out += file.begun  # nothing is missing before the first
                return
        elif file.begun and (self._restart or file.is_full(limit_bytes)):
            before = self.name
            self._end_file("goes on in the next file")
            following = self._next_file()
            self._frames += file.kept
            file = self._file = following
            self._told(True, f"{self.name}, after {before}")
            self._say_what_waited()
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
                self._say_what_waited()
            self._held.append(item)
        elif self._current.size_bytes <= self._folder.file_limit_bytes + _OVERRUN_BYTES:
            self._say(item)

    def _say(self, item: Telemetry) -> None:
        if item.message.time_ns + self._shift_ns not in _TIMES_NS:
            return
        try:
            self._current.message(item.kind, item.message, self._shift_ns)
        except RecordingError:
            raise
        except Exception:  # not JSON: its sender's error, and no reason to end a recording
            return

    def _say_what_waited(self) -> None:
        while self._held:
            self._say(self._held.popleft())

    def _flush(self) -> None:
        file = self._current
        self._folder.make_room(file.size_bytes, file.pending_bytes)
        file.flush()

    def _next_file(self) -> FlightFile:
        path = self._folder.next_path()
        self._folder.make_room(HEAD_BYTES, HEAD_BYTES)
        self._first = self._first or path.name
        self._part += 1
        head = {"recording": {"first_file": self._first, "part": str(self._part)}}
        if self._payload:
            head["payload"] = self._payload
        file = FlightFile(path, self._open_file, head)
        try:
            self._folder.sync()
        except RecordingError:
            file.close({})
            raise
        self.name, self.size_bytes = path.name, file.size_bytes
        return file

    def _end_file(self, reason: str) -> None:
        file = self._current
        with contextlib.suppress(RecordingError):  # its index may lie in what is to be left free
            self._folder.make_room(file.size_bytes, 0)
        end = {"frames": str(file.frames), "left_out": str(self.left_out)}
        file.close({**end, "reason": reason} if reason else end)
        self.size_bytes = file.written_bytes
        self._folder.sync()

    def _ask_for_idr(self) -> None:
        now_s = time.monotonic()
        if now_s - self._asked_s >= _IDR_PERIOD_S:
            self._asked_s = now_s
            with contextlib.suppress(Exception):
                self._force_idr()
