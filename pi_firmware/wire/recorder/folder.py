"""The folder of all recordings: numbered names, what fits, and what has to go for it."""

from __future__ import annotations

import os
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from pi_firmware.wire import files
from pi_firmware.wire.errors import RecordingError, os_errors_as

MB = 1_000_000
_NAME = re.compile(r"flight-([0-9]{6,9})(?:-[0-9TZ]{16})?\.mcap")
_HIGHEST = 999_999_999


class Limits(Protocol):
    """The bounds of a recorder; each side's `[recording]` table is one."""

    @property
    def folder(self) -> str:
        """Where recordings go; empty: none are made."""

    @property
    def max_file_MB(self) -> int:
        """A file ends at this size."""

    @property
    def max_total_MB(self) -> int:
        """The oldest files are deleted beyond it."""

    @property
    def min_free_MB(self) -> int:
        """What is left free on the disk."""

    @property
    def sync_s(self) -> float:
        """The most that a power cut costs."""


def number_of(name: str) -> int | None:
    """The number in the name of one of our files; None for any other."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


class Folder:
    """Our files `flight-000001.mcap` and on, and nothing else that lies there.

    Whose clock is set puts the time behind the number, as `flight-000001-20260131T142530Z.mcap`.
    Numbers rise from the highest present, whatever the clock believes. Ours is a regular file of
    such a name; a folder or a link of that name takes a number and is neither counted nor deleted.
    Methods raise `RecordingError` with one line.
    """

    def __init__(self, settings: Limits) -> None:
        self.path = Path(settings.folder)
        self._total_bytes = settings.max_total_MB * MB
        self._min_free_bytes = settings.min_free_MB * MB
        # Half of the total at most: beside the file being written there is always one to delete.
        self.file_limit_bytes = min(settings.max_file_MB * MB, self._total_bytes // 2)
        self._earlier: list[tuple[int, Path, int]] = []
        self._earlier_bytes = 0

    def next_path(self, stamp: str = "") -> Path:
        """Looks through the folder, made if missing; the path of the file to write next."""
        with self._disk_errors():
            self.path.mkdir(exist_ok=True)
            highest = self._scan()
        if highest >= _HIGHEST:
            raise RecordingError(f"recording.folder '{self.path}': no number above {highest}")
        return self.path / f"flight-{highest + 1:06d}{stamp}.mcap"

    def make_room(self, file_bytes: int, more_bytes: int) -> None:
        """For a file being written that will have `file_bytes` after `more_bytes` more.

        Deletes the oldest files beyond `max_total_MB`. Raises when they cannot be deleted, and when
        less than `min_free_MB` would be left.
        """
        while self._earlier and self._earlier_bytes + file_bytes > self._total_bytes:
            _, path, size = self._earlier[0]
            with os_errors_as(f"{path}: the oldest recording cannot be deleted", RecordingError):
                path.unlink(missing_ok=True)
            del self._earlier[0]
            self._earlier_bytes -= size
        if not self._min_free_bytes:
            return  # until the disk itself is full
        with self._disk_errors():
            disk = os.statvfs(self.path)
        free_bytes = disk.f_bavail * disk.f_frsize
        if free_bytes - more_bytes < self._min_free_bytes:
            raise RecordingError(
                f"recording.folder '{self.path}': {free_bytes // MB} MB are free, "
                f"recording.min_free_MB is {self._min_free_bytes // MB}"
            )

    def sync(self) -> None:
        """Makes names durable: of files that were begun, ended or deleted."""
        with self._disk_errors():
            files.sync(self.path)

    def _scan(self) -> int:
        """Notes our files, oldest first; the highest number taken."""
        highest = 0
        self._earlier = []
        with os.scandir(self.path) as entries:
            for entry in entries:
                number = number_of(entry.name)
                if number is None:
                    continue
                highest = max(highest, number)
                try:
                    if entry.is_file(follow_symlinks=False):
                        size = entry.stat(follow_symlinks=False).st_size
                        self._earlier.append((number, Path(entry.path), size))
                except FileNotFoundError:  # deleted while we look
                    continue
        self._earlier.sort()
        self._earlier_bytes = sum(size for _, _, size in self._earlier)
        return highest

    def _disk_errors(self) -> AbstractContextManager[None]:
        return os_errors_as(f"recording.folder '{self.path}'", RecordingError)
