"""Changes to files, each of them durable before the next one begins.

All that provisioning changes goes through here: the order of these calls is what a power cut may
stop at, and a test can count them and stop at each.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import NamedTuple


class Owner(NamedTuple):
    """Whose a file is: user and group by number, -1 leaves what it is (not root, in tests)."""

    uid: int = -1
    gid: int = -1


class Disk:
    """A file system, or a folder of one in tests. Raises `OSError` as the system does."""

    def write(
        self, path: Path, data: bytes, mode: int | None = None, owner: Owner | None = None
    ) -> None:
        """A whole file of that content. Without a mode, which a FAT has not, none is set."""
        self._step()
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(path, flags, 0o600)
        try:
            _own(descriptor, owner, mode)
            self._write_through(descriptor, data)
        finally:
            os.close(descriptor)
        self._sync_folder(path.parent)

    def overwrite(self, path: Path, data: bytes) -> None:
        """The same blocks again from the file's beginning; what lies behind `data` goes at last."""
        self._step()
        descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            self._write_through(descriptor, data)
            self._step()
            os.ftruncate(descriptor, len(data))
            self._sync(descriptor)
        finally:
            os.close(descriptor)

    def make_folder(self, path: Path, mode: int, owner: Owner | None = None) -> None:
        """A new, empty folder."""
        self._step()
        path.mkdir(mode=0o700)
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _own(descriptor, owner, mode)
            self._sync(descriptor)
        finally:
            os.close(descriptor)
        self._sync_folder(path.parent)

    def rename(self, path: Path, to: Path) -> None:
        """In one folder; an existing file of that name is replaced."""
        self._step()
        path.rename(to)
        self._sync_folder(to.parent)

    def remove(self, path: Path) -> None:
        """A file, link or folder with all that is in it; nothing when it is not there."""
        try:
            kind = path.lstat().st_mode
        except FileNotFoundError:
            return
        if stat.S_ISDIR(kind):
            for child in sorted(path.iterdir()):
                self.remove(child)
            self._step()
            path.rmdir()
        else:
            self._step()
            path.unlink()
        self._sync_folder(path.parent)

    def _write_through(self, descriptor: int, data: bytes) -> None:
        """In two halves, as a card may have taken one when power goes."""
        half = len(data) // 2
        for part in (data[:half], data[half:]):
            view = memoryview(part)
            while view:
                view = view[os.write(descriptor, view) :]
            self._sync(descriptor)
            self._step()

    def _sync_folder(self, folder: Path) -> None:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            self._sync(descriptor)
        finally:
            os.close(descriptor)

    def _sync(self, descriptor: int) -> None:
        """Written through to the card."""
        os.fsync(descriptor)

    def _step(self) -> None:
        """Called before each change, and in the midst of each longer one."""


def read_bounded(path: Path, most: int) -> bytes | None:
    """A file's bytes, at most `most` + 1 of them; None when it is not there or no plain file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return None
        return file.read(most + 1)


def _own(descriptor: int, owner: Owner | None, mode: int | None) -> None:
    if owner is not None and owner != Owner():
        os.fchown(descriptor, owner.uid, owner.gid)
    if mode is not None:
        os.fchmod(descriptor, mode)
