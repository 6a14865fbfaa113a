"""The FAT boot partition of a card or an image: read and written with mtools, never mounted."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass

from deploy.errors import DeployError
from deploy.run import run

LABEL = "BLIMPBOOT"
FOLDER = "blimp"
SECTOR_BYTES = 512
_FAT_TYPES = {0x0B, 0x0C, 0x0E}
_FREE = re.compile(rb"^\s*([\d ]+) bytes free", re.MULTILINE)
# mtools reads no settings of the user's, and does not mind a geometry that no BIOS would like.
_CLEAN = {"MTOOLSRC": "/dev/null", "MTOOLS_SKIP_CHECK": "1"}


@dataclass(frozen=True)
class BootPartition:
    """The first partition of `device`, at a byte offset; `shown` names it in errors.

    `device` is a path for mtools: of an open file under /proc, so that no name is taken for an
    option or an offset, and nobody can put another file in its place.
    """

    device: str
    offset: int
    shown: str

    @classmethod
    def find(cls, fd: int, shown: str) -> BootPartition:
        """Reads table and label of an open file; raises `DeployError` when it is none of ours."""
        head = os.pread(fd, SECTOR_BYTES, 0)
        offset = start_of_boot(head)
        if offset is None:
            raise DeployError(f"{shown}: not a card image (no partition table with a FAT first)")
        record = os.pread(fd, SECTOR_BYTES, offset)
        # FAT32 and FAT16 keep the label at different places of the first sector.
        labels = {record[place : place + 11].rstrip() for place in (71, 43)}
        if LABEL.encode() not in labels:
            raise DeployError(f"{shown}: not a card of ours: its boot partition is not {LABEL}")
        boot = cls.at(fd, offset, shown)
        if not boot.has(FOLDER):
            raise DeployError(f"{shown}: its boot partition has no folder '{FOLDER}'")
        return boot

    @classmethod
    def at(cls, fd: int, offset: int, shown: str) -> BootPartition:
        """The partition of an open file, whose table is not looked at."""
        return cls(f"/proc/{os.getpid()}/fd/{fd}", offset, shown)

    def files(self, folder: str) -> list[str]:
        """The paths of all files and folders in a folder; empty when it is not there."""
        try:
            listed = self._run("mdir", "-b", "-a", "-/", f"::/{folder}").decode(errors="replace")
        except DeployError as error:
            if "not found" in str(error):
                return []
            raise
        lines = (line.strip().removeprefix("::/").rstrip("/") for line in listed.splitlines())
        return [line for line in lines if line and line != folder]

    def has(self, path: str) -> bool:
        """Whether a file or a folder is there."""
        folder = path.rpartition("/")[0]
        return path.lower() in map(str.lower, self.files(folder))

    def read(self, path: str) -> bytes:
        """A file's bytes."""
        return self._run("mtype", f"::/{path}")

    def write(self, path: str, data: bytes) -> None:
        """Writes a file again; its folder must be there."""
        self._run("mcopy", "-o", "-D", "o", "-", f"::/{path}", data=data)

    def make_folder(self, path: str) -> None:
        """Makes a folder that is not there yet."""
        self._run("mmd", "-D", "s", f"::/{path}")

    def remove(self, path: str) -> None:
        """Removes a file."""
        self._run("mdel", f"::/{path}")

    def free_bytes(self) -> int:
        """What is free for files, bytes."""
        match = _FREE.search(self._run("mdir", "::/"))
        if match is None:
            raise DeployError(f"{self.shown}: its boot partition is damaged")
        return int(match[1].replace(b" ", b""))

    def _run(self, tool: str, *words: str, data: bytes | None = None) -> bytes:
        # After the options comes the image, then what is done.
        arguments = [tool, "-i", f"{self.device}@@{self.offset}", *words]
        try:
            return run(arguments, input=data, env=_CLEAN, timeout_s=120)
        except DeployError as error:
            text = str(error).replace(self.device, self.shown)
            if "full" in text.lower():
                text = "it is full"
            raise DeployError(f"{self.shown}: boot partition: {text}") from None


def start_of_boot(head: bytes) -> int | None:
    """Where a card's first partition starts, bytes, by its first sector; None when it is no FAT."""
    if len(head) < SECTOR_BYTES or head[510:512] != b"\x55\xaa" or head[450] not in _FAT_TYPES:
        return None
    start, sectors = struct.unpack_from("<II", head, 454)
    return start * SECTOR_BYTES if start and sectors else None
