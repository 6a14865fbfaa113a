"""What is never written, each with its reason; a refusal comes before anything was touched."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from deploy.errors import DeployError, printable
from deploy.flash.disks import Disk, Machine


def find(machine: Machine, path: Path) -> Disk | None:
    """The disk at a path, checked; None when an image file is there instead.

    Raises `DeployError` for everything that is not a card in a reader, whole, writable and idle.
    """
    try:
        facts = path.stat()
    except OSError as error:
        hint = ""
        if isinstance(error, FileNotFoundError):
            hint = "; put the card in, and lsblk -o NAME,SIZE,MODEL,RM names it"
            if not path.is_relative_to("/dev"):
                hint = f"; to write a file, make it as large as the card: truncate -s 8G {path}"
        raise DeployError(f"{path}: {error.strerror or error}{hint}") from None
    if stat.S_ISREG(facts.st_mode):
        loop = machine.loop_on(path.resolve())
        if loop:
            raise DeployError(f"{path}: it is in use as {loop}: sudo losetup -d /dev/{loop}")
        return None
    if not stat.S_ISBLK(facts.st_mode):
        raise DeployError(f"{path}: neither a disk nor an image file")
    name = machine.name_of(os.major(facts.st_rdev), os.minor(facts.st_rdev))
    if name is None:
        raise DeployError(f"{path}: the kernel knows no such disk")
    whole = machine.whole(name)
    if whole != name:
        raise DeployError(f"{path}: a partition; name the whole disk, /dev/{whole}")
    check(machine, machine.disk(name))
    return machine.disk(name)


def check(machine: Machine, disk: Disk) -> None:
    """Raises `DeployError` when the disk must not be written."""
    device = f"/dev/{disk.name}"
    uses = machine.uses(disk.name)
    if uses and uses[0].system:
        raise DeployError(f"{device}: this machine runs on it ({uses[0].what})")
    if uses:
        raise DeployError(f"{device}: in use: {uses[0].what}")
    if not disk.is_disk:
        raise DeployError(f"{device}: {disk.model}: not a disk")
    if not disk.is_card:
        raise DeployError(
            f"{device}: {disk.model}, {shown_size(disk.size_bytes)}, is a fixed disk (not"
            " removable); only cards are written"
        )
    if disk.size_bytes == 0:
        raise DeployError(f"{device}: no card in it")
    if disk.read_only:
        raise DeployError(f"{device}: write-protected; look at the switch on the card's side")


def check_size(path: Path, size: int, needed: int) -> None:
    """Raises `DeployError` when the image does not fit."""
    if size < needed:
        raise DeployError(
            f"{path}: {size} bytes ({shown_size(size)}); the image needs {needed}"
            f" ({shown_size(needed)})"
        )


def describe(path: Path, disk: Disk | None, size: int) -> str:
    """The disk in a few lines, so that a person can see whether it is the one they mean."""
    if disk is None:
        return f"{path}: image file, {shown_size(size)}"
    lines = [
        f"{path}: {disk.model}, {shown_size(disk.size_bytes)}, serial {disk.serial}",
        *(
            f"  {part.name}: {shown_size(part.size_bytes)} {part.file_system} {part.label}".rstrip()
            for part in disk.partitions
        ),
    ]
    return "\n".join(map(printable, lines)) + ("" if disk.partitions else "\n  no partitions")


def shown_size(size: int) -> str:
    """Bytes as a card's label says them: powers of ten."""
    value, unit = float(size), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if value >= 100 or unit == "B" else f"{value:.1f} {unit}"
