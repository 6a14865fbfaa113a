"""One recording from start to stop: what waits for the disk, and the thread that writes files."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pi_firmware.wire import annexb, sei
from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.recorder.file import CHUNK_BYTES, HEAD_BYTES, OpenFile, RecordingFile
from pi_firmware.wire.recorder.folder import Folder, Limits

_ITEM_BYTES = 512
"""What an item takes beside a unit's bytes, about; any other as a whole."""


@dataclass(frozen=True, slots=True)
class Unit:
    """An access unit, and when it came, by the monotonic clock.

    `stream` tells apart the cameras of a recording; `log_ns` is its log time where that is not its
    capture time.
    """

    info: sei.FrameInfo
    data: bytes
    arrived_s: float
    stream: str = ""
    log_ns: int | None = None


class Queue:
    """A queue from many threads to one.

    When a unit does not fit, it and all that follow of its stream are left out up to an IDR that
    finds the queue half empty: what is recorded of a group of pictures is always its beginning, so
    it decodes.
    """

    def __init__(self, limit_bytes: int, wake_bytes: int) -> None:
        self.left_out = 0
        """Units that were not taken."""
        self._limit_bytes, self._wake_bytes = limit_bytes, wake_bytes
        self._items: deque[tuple[int, object]] = deque()
        self._bytes = 0
        self._skipping: set[str] = set()
        self._closed = self._broken = False
        self._lock = threading.Lock()
        self._wake = threading.Event()

    def unit(
        self, info: sei.FrameInfo, access_unit: bytes, stream: str = "", log_ns: int | None = None
    ) -> None:
        """Queues an access unit, or counts it as left out."""
        size = len(access_unit) + _ITEM_BYTES
        with self._lock:
            if self._closed:
                self.left_out += self._broken
                return
            takes = self._bytes + size <= self._limit_bytes
            if stream in self._skipping:
                # Only now does anyone look into the unit: the encoder's thread has little time.
                calm = self._bytes <= self._limit_bytes // 2
                takes = takes and calm and annexb.is_idr(access_unit)
            if takes:
                self._skipping.discard(stream)
                self._add(Unit(info, access_unit, time.monotonic(), stream, log_ns), size)
            else:
                self._skipping.add(stream)
                self.left_out += 1

    def put(self, item: object, size_bytes: int = 0) -> None:
        """Queues anything else, of so many bytes beside itself; a full queue does not take it."""
        size = size_bytes + _ITEM_BYTES
        with self._lock:
            if not self._closed and self._bytes + size <= self._limit_bytes:
                self._add(item, size)

    def wait(self, until_s: float) -> bool:
        """Until this monotonic time, or until much waits; whether the end has come."""
        self._wake.wait(max(0.0, until_s - time.monotonic()))
        if not self._closed:
            self._wake.clear()
        return self._closed

    def take(self) -> object | None:
        """The oldest item, None when there is none."""
        with self._lock:
            if not self._items:
                return None
            size, item = self._items.popleft()
            self._bytes -= size
            return item

    def close(self, *, broken: bool = False) -> None:
        """From now on nothing is taken; what waits can still be.

        `broken`: nobody asked for it, so units that come until all know of it are left out, too.
        """
        with self._lock:
            self._broken = self._broken or (broken and not self._closed)
            self._closed = True
        self._wake.set()

    def clear(self) -> None:
        """Leaves out what still waits."""
        with self._lock:
            self.left_out += sum(isinstance(item, Unit) for _, item in self._items)
            self._items.clear()
            self._bytes = 0

    def _add(self, item: object, size: int) -> None:
        self._items.append((size, item))
        self._bytes += size
        if self._bytes >= self._wake_bytes:
            self._wake.set()


QUEUE_BYTES = 8_000_000
"""What may wait for the disk: half a minute at 2 Mbit/s."""

_SYNC_SHARE = 0.75
"""Of `sync_s`, from one sync to the next: the rest is the card's, to take what was handed to it."""

_DRAIN_LIMIT_S = 3.0
"""How long an end waits for a slow disk to take what is queued."""

_IDR_PERIOD_S = 1.0
OVERRUN_BYTES = 8_000_000
"""A file whose next one cannot begin yet may outgrow its limit by so much."""
TIMES_NS = range(1 << 63)
"""What MCAP and its readers take."""


class Run(ABC):
    """Writes what `queue` is given until `end`, or until the disk takes no more.

    `report` is called on the thread with True and a text for a file that goes on from another, and
    once with False and how much there is when all has ended, and why unless `end` was called.
    What an item is, where it goes and when the next file begins is a subclass's: `_put`.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        report: Callable[[bool, str], None],
        force_idr: Callable[[], object],
        head: Mapping[str, Mapping[str, str]],
        open_file: OpenFile,
        queue_bytes: int = 0,
    ) -> None:
        self.queue = Queue(queue_bytes or QUEUE_BYTES, CHUNK_BYTES)
        self.name = ""
        self.size_bytes = 0
        """Of the file `name`."""
        self.reason = ""
        """Why it ended, in words, when nobody asked for it."""
        self._limits = limits
        self._report, self._force_idr = report, force_idr
        self._head = dict(head)
        self._open_file = open_file
        self._folder = Folder(limits)
        self._files: list[RecordingFile] = []
        """Those being written: the newest last, and others only while their last frames come."""
        self._first = ""
        self._part = 0
        self._frames = 0  # in earlier files
        self._given_up = False
        self._left_out = 0
        self._asked_s = float("-inf")
        self._refused: str | None = None
        self._opened, self._closed = threading.Event(), threading.Event()
        self._go = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def left_out(self) -> int:
        """Frames that are in no file since it began to record: the disk was slow or broke, or the
        clock was set and the frames up to the next IDR belong to neither file."""
        return self._left_out + self.queue.left_out

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

        What `report` does of it may take as long again, at most.
        """
        self.queue.close()
        done = self._closed.wait(limit_s)
        if done:
            self._thread.join(limit_s)
        return done

    def give_up(self) -> None:
        """Ends it without waiting, and tells nothing of it any more."""
        self._given_up = True
        self.queue.close()
        self._go.set()

    def is_alive(self) -> bool:
        """Whether its thread still runs: it hangs on a disk when `end` was not done."""
        return self._thread.is_alive()

    @abstractmethod
    def _put(self, item: object) -> None:
        """Writes an item of the queue; a frame that cannot be written is one of `_left_out`."""

    def _stamp(self) -> str:
        """What a file's name says behind its number; nothing where the clock may be wrong."""
        return ""

    def _lacks(self) -> Mapping[str, str]:
        """What else an ending file says of the frames that it has not, by why."""
        return {}

    def _before_end(self) -> None:  # noqa: B027  # what a file needs at its end, if anything
        """All of the queue is written; what else there is goes into the file now."""

    def _run(self) -> None:
        reason: str | None = None
        try:
            self._open_next()
            self._opened.set()
            self._go.wait()
            self._write()
        except RecordingError as error:
            reason = str(error)
        except Exception as error:  # whatever it is, a flight does not end for its recording
            reason = f"{type(error).__name__}: {error}"
        self.queue.close(broken=reason is not None)
        self.queue.clear()
        if not self._opened.is_set():
            self._refused = reason
            self._opened.set()
            return
        for file in list(self._files):
            try:
                self._end_file(file, reason or "")
            except Exception as error:
                reason = reason or str(error)
        self.reason = reason or ""
        self._closed.set()
        if not self._given_up:
            self._report(False, self._summary(reason))

    def _summary(self, reason: str | None) -> str:
        names = self.name if self.name == self._first else f"{self._first} to {self.name}"
        text = f"{names}: {self._frames} frames"
        return f"{text}; {reason}" if reason else text

    def _write(self) -> None:
        period_s = _SYNC_SHARE * self._limits.sync_s
        due_s = wake_s = time.monotonic() + period_s
        last_s = math.inf
        while True:
            ending = self.queue.wait(wake_s)
            now_s = time.monotonic()
            if ending:
                last_s = min(last_s, now_s + _DRAIN_LIMIT_S)
            pause_s = min(now_s + period_s, last_s)  # however much waits, it is synced between
            while (item := self.queue.take()) is not None:
                self._put(item)
                self.size_bytes = self._current.size_bytes
                if self._current.pending_bytes >= CHUNK_BYTES:
                    self._flush(self._current)
                if time.monotonic() >= pause_s:
                    break
            now_s = time.monotonic()
            if ending and (item is None or now_s >= last_s):
                self._before_end()
                return
            if now_s >= due_s:
                due_s = now_s + period_s
                for file in self._files:
                    self._flush(file)
                    file.sync()
            wake_s = due_s if item is None else now_s

    @property
    def _current(self) -> RecordingFile:
        return self._files[-1]

    def _flush(self, file: RecordingFile) -> None:
        self._folder.make_room(file.size_bytes, file.pending_bytes)
        file.flush()

    def _turn(self) -> None:
        """Begins the next file beside the one of now, which is to be ended by `_end_earlier`."""
        before = self.name
        self._open_next()
        self._report(True, f"{self.name}, after {before}")

    def _end_earlier(self, file: RecordingFile) -> None:
        """Ends a file that has all that belongs to it, while the newest goes on."""
        self._end_file(file, "goes on in the next file")

    def _open_next(self) -> None:
        path = self._folder.next_path(self._stamp())
        self._folder.make_room(HEAD_BYTES, HEAD_BYTES)
        self._first = self._first or path.name
        self._part += 1
        head = {"recording": {"first_file": self._first, "part": str(self._part)}, **self._head}
        file = RecordingFile(path, self._open_file, head)
        try:
            self._folder.sync()
        except RecordingError:
            file.close({})
            raise
        self._files.append(file)
        self.name, self.size_bytes = path.name, file.size_bytes

    def _end_file(self, file: RecordingFile, reason: str) -> None:
        with contextlib.suppress(RecordingError):  # its index may lie in what is to be left free
            self._folder.make_room(file.size_bytes, 0)
        end = {"frames": str(file.frames), "left_out": str(self.left_out), **self._lacks()}
        try:
            file.close({**end, "reason": reason} if reason else end)
        finally:
            self._files.remove(file)
            self._frames += file.kept
            self._left_out += file.frames - file.kept
        if not self._files:
            self.size_bytes = file.written_bytes
        self._folder.sync()

    def _ask_for_idr(self) -> None:
        now_s = time.monotonic()
        if now_s - self._asked_s >= _IDR_PERIOD_S:
            self._asked_s = now_s
            with contextlib.suppress(Exception):
                self._force_idr()
