"""Writes an image so that a card is either whole or has no partition table at all.

    1. The first sectors become zeros. From here on the card boots nothing: the Pi's first stage
       finds the boot partition by the table in sector 0, and so does every other machine.
    2. Everything else is written, waited for, read back past the system's memory and compared.
    3. The boot partition is customised and compared, too.
    4. The first sectors follow, sector 0 as the very last: one sector, which a card writes whole
       or not at all.

So power cut, Ctrl-C, a pulled card or a write error between 1 and 4 leave a card that is plainly
empty, never one that boots half of something.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import stat
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from deploy.errors import DeployError, Interrupted
from deploy.flash.boot import SECTOR_BYTES
from deploy.flash.image import CHUNK_BYTES, Image, Stretch, chunks
from deploy.progress import Progress

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


# Table and gap before the first partition; an older table of the other kind (GPT) lies there, too.
HEAD_BYTES = 1 << 20
# Waited for so often, so that the bar tells what is on the card and Ctrl-C does not wait long.
_FLUSH_BYTES = 32 << 20
UNKNOWN = "what the card holds now is not known; flash it again"
NOT_BOOTABLE = "the card has no partition table now and does not boot; flash it again"


def write(image: Image, target: Target, customise: Callable[[], object]) -> None:
    """Writes the image, calls `customise`, and makes the card bootable at the very end.

    Raises `DeployError` with one line that says where it failed and what the card is now.
    """
    head = Stretch(0, min(HEAD_BYTES, image.boot.offset))
    behind = (Stretch(max(part.start, head.stop), part.stop) for part in image.stretches)
    body = [part for part in behind if part.start < part.stop]
    # Whether zeros are known to stand in sector 0, whatever the card answers from then on.
    table_gone = False
    try:
        target.write(0, bytes(head.stop))
        _flush(target, 0)
        table_gone = True
        _write(image, target, body)
        _compare(image, target, body)
        customise()
        first = Stretch(0, SECTOR_BYTES)
        rest = Stretch(SECTOR_BYTES, head.stop)
        for last in (rest, first):
            table_gone = last is rest
            for start, data in chunks(image.file, last):
                target.write(start, data)
            _flush(target, last.start)
        _compare(image, target, [head], quiet=True)
    except BaseException as error:
        known = table_gone or _zero_again(target)
        state = NOT_BOOTABLE if known else UNKNOWN
        if isinstance(error, KeyboardInterrupt | Interrupted):
            raise Interrupted(f"{target.path}: interrupted: {state}") from None
        if isinstance(error, OSError):
            raise DeployError(f"{target.path}: {error.strerror or error}: {state}") from None
        if isinstance(error, DeployError):
            raise DeployError(f"{error}: {state}") from None
        raise


def _zero_again(target: Target) -> bool:
    """Takes sector 0 away, should it be there already; False when that cannot be said."""
    try:
        if target.read(0, SECTOR_BYTES).count(0) != SECTOR_BYTES:
            target.write(0, bytes(SECTOR_BYTES))
            target.flush()
        return target.read(0, SECTOR_BYTES).count(0) == SECTOR_BYTES
    except OSError:
        return False


def _write(image: Image, target: Target, stretches: list[Stretch]) -> None:
    waiting = 0
    with Progress("writing", sum(part.stop - part.start for part in stretches)) as progress:
        for stretch in stretches:
            for start, data in chunks(image.file, stretch):
                with _failing(target, "write", start):
                    target.write(start, data)
                waiting += len(data)
                if waiting >= _FLUSH_BYTES:
                    _flush(target, start)
                    waiting = 0
                progress.advance(len(data))
        _flush(target, stretches[-1].stop if stretches else 0)


def _compare(
    image: Image, target: Target, stretches: list[Stretch], *, quiet: bool = False
) -> None:
    """Reads back past the system's memory; raises `DeployError` at the first other byte."""
    target.forget()
    total = sum(part.stop - part.start for part in stretches)
    shown = contextlib.nullcontext() if quiet else Progress("reading back", total)
    with shown as progress:
        for stretch in stretches:
            for start, data in chunks(image.file, stretch):
                with _failing(target, "read", start):
                    got = target.read(start, len(data))
                if got != data:
                    at = start + _first_difference(got, data)
                    raise DeployError(
                        f"{target.path}: byte {at} reads back otherwise than it was written: the"
                        " card or the reader is bad"
                    )
                if progress is not None:
                    progress.advance(len(data))


def _first_difference(one: bytes, other: bytes) -> int:
    size = min(len(one), len(other), CHUNK_BYTES)
    return next((i for i in range(size) if one[i] != other[i]), size)


def _flush(target: Target, start: int) -> None:
    with _failing(target, "write", start):
        target.flush()


@contextlib.contextmanager
def _failing(target: Target, what: str, start: int) -> Iterator[None]:
    """Tells of a card's error where it was."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise DeployError(f"{target.path}: {what} error at about byte {start}: {reason}") from None
