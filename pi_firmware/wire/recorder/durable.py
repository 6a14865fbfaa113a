"""A file whose content is the disk's, not a buffer's."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path


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
