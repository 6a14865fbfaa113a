"""What is written: a card's device or an image file, opened for this program alone."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import stat
import struct
from pathlib import Path

from deploy.errors import DeployError

# linux/fs.h; Python names none of them.
_BLKRRPART, _BLKGETSIZE64, _BLKFLSBUF = 0x125F, 0x80081272, 0x1261
_ALIGN_BYTES = 4096  # O_DIRECT: at least a disk's own sector


class Target:
    """A device or file that nobody else may write or mount until it is closed.

    On a device the kernel refuses (EBUSY) when a partition of it is mounted, and refuses mounts
    from then on; a file is locked against a second flasher.
    """

    def __init__(self, path: Path, fd: int) -> None:
        self.path, self._fd = path, fd
        self.is_device = stat.S_ISBLK(os.fstat(fd).st_mode)
        self._direct_fd = self._open_direct()
        self.size = self._size()

    @classmethod
    def open(cls, path: Path) -> Target:
        """Opens it; raises `DeployError` with one line when it is busy or may not be written."""
        device = stat.S_ISBLK(path.stat().st_mode)
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | (os.O_EXCL if device else 0))
        except OSError as error:
            reason = error.strerror
            if error.errno == errno.EBUSY:
                reason = "in use by the system or another program"
            elif error.errno in (errno.EACCES, errno.EPERM):
                reason = "may not be written; run it as root (sudo)" if device else reason
            elif error.errno == errno.ENOMEDIUM:
                reason = "no card in it"
            raise DeployError(f"{path}: {reason}") from None
        try:
            if not device:
                # Not flock, which mtools takes itself; and not the process's own kind, which goes
                # when any file number of it is closed: fcntl(2), open file description locks.
                whole = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
                fcntl.fcntl(fd, fcntl.F_OFD_SETLK, whole)
            return cls(path, fd)
        except OSError as error:
            os.close(fd)
            busy = error.errno in (errno.EACCES, errno.EAGAIN)
            reason = "another program writes it" if busy else error.strerror
            raise DeployError(f"{path}: {reason}") from None

    def fileno(self) -> int:
        """The open file's number."""
        return self._fd

    def write(self, offset: int, data: bytes) -> None:
        """Writes all of the data; raises `OSError`."""
        view = memoryview(data)
        while view:
            done = os.pwrite(self._fd, view, offset)
            offset, view = offset + done, view[done:]

    def flush(self) -> None:
        """Waits until all that was written is on the card; raises `OSError`."""
        os.fsync(self._fd)

    def read(self, offset: int, size: int) -> bytes:
        """Reads from the card itself, past the system's memory; short at the end."""
        if self._direct_fd is None:
            os.posix_fadvise(self._fd, offset, size, os.POSIX_FADV_DONTNEED)
            return os.pread(self._fd, size, offset)
        start = offset // _ALIGN_BYTES * _ALIGN_BYTES
        stop = -(-(offset + size) // _ALIGN_BYTES) * _ALIGN_BYTES
        with mmap.mmap(-1, stop - start) as buffer:  # O_DIRECT wants memory at a page's start
            done = os.preadv(self._direct_fd, [buffer], start)
            return buffer[offset - start : min(done, offset - start + size)]

    def forget(self) -> None:
        """Drops what the system keeps in memory of it, for programs that read it the common way."""
        self.flush()
        if self.is_device:
            with contextlib.suppress(OSError):  # not root: reading directly does without it
                fcntl.ioctl(self._fd, _BLKFLSBUF)
        os.posix_fadvise(self._fd, 0, 0, os.POSIX_FADV_DONTNEED)

    def reread_table(self) -> bool:
        """Makes the kernel take the partition table again; False when it must be plugged again."""
        if not self.is_device:
            return True
        try:
            fcntl.ioctl(self._fd, _BLKRRPART)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Lets others have it."""
        if self._direct_fd is not None:
            os.close(self._direct_fd)
        os.close(self._fd)

    def _open_direct(self) -> int | None:
        try:  # by the open file, not by the name: another file could be there by now
            return os.open(f"/proc/self/fd/{self._fd}", os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECT)
        except OSError:  # a file system that cannot, as tmpfs
            return None

    def _size(self) -> int:
        if not self.is_device:
            return os.fstat(self._fd).st_size
        answer = fcntl.ioctl(self._fd, _BLKGETSIZE64, bytes(8))
        return int.from_bytes(answer, "little")

    def __enter__(self) -> Target:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
