"""One file of a recording: video, what the camera told of each frame, and what else is said."""

from __future__ import annotations

import contextlib
import errno
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

from pi_firmware.wire import sei
from pi_firmware.wire.errors import BlimpError, RecordingError, os_errors_as

if TYPE_CHECKING:
    from pi_firmware.wire.recording import RecordingWriter


class DurableFile:
    """A new file, never one that is there; after a write that failed it takes no other.

    Not buffered: what was written is the system's, and after `sync` the card's.
    """

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._handle = os.open(path, flags, 0o644)
        self._at = 0
        self._failure: OSError | None = None
        self.closed = False

    def write(self, data: bytes) -> int:
        """Writes all of it or raises `OSError`."""
        if self.closed:
            raise OSError(errno.EBADF, "the file is closed")
        if self._failure is not None:
            raise self._failure
        rest = memoryview(data)
        try:
            while rest:
                written = self._write(rest)
                self._at += written
                rest = rest[written:]
        except OSError as error:
            self._failure = error
            raise
        return len(data)

    def _write(self, data: memoryview) -> int:
        return os.write(self._handle, data)

    def tell(self) -> int:
        """Bytes written."""
        return self._at

    def flush(self) -> None:
        """Nothing is held back."""

    def sync(self) -> None:
        """Waits until the card has it; a file that somebody deleted is no place for more."""
        try:
            os.fdatasync(self._handle)
            if os.fstat(self._handle).st_nlink == 0:
                raise OSError(errno.ENOENT, "deleted while it was written")
        except OSError as error:  # the system forgets what it could not write: no second chance
            self._failure = error
            raise

    def close(self) -> None:
        """Syncs and closes; a second call does nothing."""
        if not self.closed:
            self.closed = True
            try:
                if self._failure is None:
                    self.sync()
            finally:
                os.close(self._handle)

    def __enter__(self) -> DurableFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


OpenFile = Callable[[Path], DurableFile]


CHUNK_BYTES = 256 * 1024
"""A chunk ends, and is written, when it has so much or is synced, and only if there is room."""

_NEVER_BY_ITSELF = 1 << 40
FRAME_SCHEMA = "blimp.Frame"
_RECORD_BYTES = 96
"""What a message takes in the file beside its content, at most: record, protobuf, index."""
HEAD_BYTES = 32 * 1024
"""Schemas and channels, at the file's head and again in its index."""
_CHUNK_INDEX_BYTES = 512
_MAX_CHUNKS = 8192
"""The index of a file's chunks is held in memory until the file ends: about 1 kB each."""


class RecordingFile:
    """Writes one file; raises `RecordingError` with one line when the disk does not take it.

    `head` are metadata tables. Its video begins with the first unit given, which is to be an IDR.
    """

    def __init__(
        self, path: Path, open_file: OpenFile, head: Mapping[str, Mapping[str, str]]
    ) -> None:
        # Here and not above: a payload that only streams loads no writer.
        from pi_firmware.wire import recording

        self.path = path
        self.frames = 0
        self.kept = 0
        """Frames of these that are in the file for certain."""
        self._kinds = recording
        self.pending_bytes = 0
        """What a flush would write, about."""
        self._chunks = 0
        self._gop_bytes = self._longest_gop_bytes = 0
        self._unsynced = True
        self._ended = False
        with os_errors_as(path, RecordingError):
            self._file = open_file(path)
        try:
            self.writer = self._opened(head)
            """What its other messages are written with; to be told of by `added`."""
        except BaseException:
            with contextlib.suppress(OSError):
                self._file.close()
            with contextlib.suppress(OSError):
                path.unlink()  # nothing is in it
            raise

    def _opened(self, head: Mapping[str, Mapping[str, str]]) -> RecordingWriter:
        """The writer, with the file's head on the card."""
        writer = self._kinds.RecordingWriter(
            self.path, chunk_bytes=_NEVER_BY_ITSELF, open_file=lambda _: cast(IO[bytes], self._file)
        )
        for name, values in head.items():
            writer.write_metadata(name, values)
        with os_errors_as(self.path, RecordingError):
            self._file.sync()
        return writer

    @property
    def size_bytes(self) -> int:
        """What the file would have if it ended now, at most."""
        index_bytes = HEAD_BYTES + _CHUNK_INDEX_BYTES * (self._chunks + 1)
        return self._file.tell() + self.pending_bytes + index_bytes

    @property
    def written_bytes(self) -> int:
        """What it has."""
        return self._file.tell()

    @property
    def begun(self) -> bool:
        """Whether it has video."""
        return self.frames > 0

    def is_full(self, limit_bytes: int) -> bool:
        """Whether another group of pictures, as long as the longest, would not fit."""
        too_long = self.size_bytes + self._longest_gop_bytes > limit_bytes
        return too_long or self._chunks >= _MAX_CHUNKS

    def unit(
        self,
        info: sei.FrameInfo,
        access_unit: bytes,
        *,
        idr: bool,
        prefix: str = "",
        log_ns: int | None = None,
    ) -> None:
        """Adds an access unit and what the camera told of its frame.

        `prefix` is put before the topics, `log_ns` is the log time where it is not the capture's.
        """
        log_ns = info.time_ns if log_ns is None else log_ns
        told = {"exposure_s": info.exposure_s, "gain": info.gain}
        known = {k: v for k, v in told.items() if v is not None and math.isfinite(v)}
        topic = prefix + self._kinds.VIDEO_TOPIC
        self.writer.write_video(info.time_ns, access_unit, topic=topic, log_ns=log_ns)
        self.writer.write_json(
            prefix + self._kinds.FRAME_INFO_TOPIC,
            log_ns,
            {"sequence": info.sequence, **known},
            schema_name=FRAME_SCHEMA,
        )
        self.frames += 1
        self.added(len(access_unit) + 100)
        self._gop_bytes = len(access_unit) + (0 if idr else self._gop_bytes)
        self._longest_gop_bytes = max(self._longest_gop_bytes, self._gop_bytes)

    def added(self, content_bytes: int) -> None:
        """One more message, of so many bytes, was written with `writer`."""
        self.pending_bytes += content_bytes + _RECORD_BYTES
        self._unsynced = True

    def flush(self) -> None:
        """Ends the chunk in progress: all so far is in the file."""
        if self.pending_bytes:
            self.writer.flush()
            self.pending_bytes = 0
            self._chunks += 1
            self.kept = self.frames

    def sync(self) -> None:
        """Flushes, and waits until the card has it; does nothing when it has all."""
        if self._unsynced:
            self.flush()
            with os_errors_as(self.path, RecordingError):
                self._file.sync()
            self._unsynced = False

    def close(self, end: Mapping[str, str]) -> None:
        """Writes the table `recording_end`, index and footer, and syncs.

        After a write that failed the file stays as it is: readable up to there, without a footer.
        A second call does nothing.
        """
        if self._ended:
            return
        self._ended = True
        with contextlib.suppress(BlimpError):
            self.writer.write_metadata("recording_end", end)
        self.writer.close()
        self.kept = self.frames
