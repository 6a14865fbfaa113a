"""What the kernel tells of a disk, and which ones are never written, each with its reason.

From sysfs, /proc and udev's database under one root folder, so that a recorded tree can stand for
a machine: https://docs.kernel.org/admin-guide/abi-stable-files.html, `proc_pid_mountinfo(5)`.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import DeployError, printable

SECTOR_BYTES = 512  # the unit of `size` and `start` in sysfs, whatever the disk's own is
# A disk under one of these is the one that the running system lives on.
_SYSTEM_MOUNTS = ("/", "/boot", "/boot/efi", "/boot/firmware", "/usr", "/var", "/etc")
_OCTAL = re.compile(r"\\([0-7]{3})")


@dataclass(frozen=True)
class Partition:
    """A partition as the kernel knows it, with what udev found in it ("" where it told nothing)."""

    name: str
    size_bytes: int
    file_system: str
    label: str


@dataclass(frozen=True)
class Disk:
    """A whole disk."""

    name: str
    size_bytes: int
    model: str
    serial: str
    is_card: bool
    """Removable, or an SD card in a built-in slot, which the kernel calls fixed."""
    is_disk: bool
    """Not a CD, a tape or a floppy."""
    read_only: bool
    partitions: tuple[Partition, ...]


@dataclass(frozen=True)
class Use:
    """Who works with a disk now, in words; `system` when this machine runs on it."""

    what: str
    system: bool = False


class Machine:
    """The disks of the machine whose `/sys`, `/proc` and `/run` lie under `root`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self._root = root
        self._folders: dict[str, Path] = {}
        self._names: dict[str, str] = {}
        for entry in _children(root / "sys/class/block"):
            folder = entry.resolve()
            self._folders[entry.name] = folder
            self._names[_text(folder / "dev")] = entry.name

    def name_of(self, major: int, minor: int) -> str | None:
        """The kernel's name of a block device, as sdb or sdb1."""
        return self._names.get(f"{major}:{minor}")

    def whole(self, name: str) -> str:
        """The disk that a partition is a part of; a disk's own name."""
        folder = self._folders[name]
        return folder.parent.name if (folder / "partition").exists() else name

    def disk(self, name: str) -> Disk:
        """The facts of a whole disk."""
        folder = self._folders[name]
        found = self._udev(folder)
        device = folder / "device"
        kind = _text(device / "type")  # of a card: SD, MMC, SDIO; of SCSI: 0 is a disk
        card = name.startswith("mmcblk")
        model = " ".join(filter(None, (_text(device / "vendor"), _text(device / "model"))))
        return Disk(
            name=name,
            size_bytes=_number(folder / "size") * SECTOR_BYTES,
            model=model or _text(device / "name") or "unknown",
            serial=found.get("ID_SERIAL_SHORT") or _text(device / "serial") or "unknown",
            is_card=kind == "SD" if card else _number(folder / "removable") == 1,
            is_disk=card or kind in ("", "0"),
            read_only=_number(folder / "ro") == 1,
            partitions=tuple(self._partitions(folder)),
        )

    def uses(self, name: str) -> list[Use]:
        """Who works with a disk or a part of it, directly or through LVM, dm-crypt, RAID, loops."""
        uses = []
        for number, source, point in self._mounts():
            used = self._names.get(number) or self._by_source(source)
            if used and name in self._beneath(used):
                uses.append(Use(f"{used} is mounted on {point}", point in _SYSTEM_MOUNTS))
        for line in _text(self._root / "proc/swaps").splitlines()[1:]:
            swap = _unescaped(line.split()[0]) if line.split() else ""
            used = self._by_source(swap)
            if used and name in self._beneath(used):
                uses.append(Use(f"{swap} is swap space", True))
        for part in (self._folders[name], *self._parts(self._folders[name])):
            for holder in _children(part / "holders"):
                called = _text(holder.resolve() / "dm/name")
                shown = f"{holder.name} ({called})" if called else holder.name
                uses.append(Use(f"{part.name} is held by {shown}"))
        return sorted(uses, key=lambda use: not use.system)

    def loop_on(self, file: Path) -> str | None:
        """The loop device that shows a file as a disk; None when there is none."""
        for name, folder in self._folders.items():
            if _text(folder / "loop/backing_file") == str(file):
                return name
        return None

    def _beneath(self, name: str, seen: frozenset[str] = frozenset()) -> set[str]:
        """The names of all devices below a device, itself among them."""
        if name in seen or name not in self._folders:
            return set()
        seen |= {name}
        found = {name}
        whole = self.whole(name)
        if whole != name:
            return found | self._beneath(whole, seen)
        folder = self._folders[name]
        for slave in _children(folder / "slaves"):
            found |= self._beneath(slave.name, seen)
        backing = _text(folder / "loop/backing_file")
        if backing and (below := self._holder_of(backing)):
            found |= self._beneath(below, seen)
        return found

    def _holder_of(self, file: str) -> str | None:
        """The device whose file system holds a file: that of the longest mount point above it."""
        best, name = -1, None
        for number, source, point in self._mounts():
            inside = file.startswith(point.rstrip("/") + "/")
            if inside and len(point) >= best:
                best, name = len(point), self._names.get(number) or self._by_source(source)
        return name

    def _mounts(self) -> Iterator[tuple[str, str, str]]:
        """Device number, source and mount point of each mount."""
        for line in _text(self._root / "proc/self/mountinfo").splitlines():
            words = line.split(" ")
            if len(words) >= 10 and "-" in words[6:]:
                source = words[words.index("-", 6) + 2]
                yield words[2], _unescaped(source), _unescaped(words[4])

    def _by_source(self, source: str) -> str | None:
        """A block device by its path: btrfs, for one, mounts under a number of its own."""
        name = source.removeprefix("/dev/")
        if name == source:
            return None
        if mapped := name.removeprefix("mapper/") if name.startswith("mapper/") else "":
            for known, folder in self._folders.items():
                if _text(folder / "dm/name") == mapped:
                    return known
        return name if name in self._folders else None

    def _parts(self, folder: Path) -> list[Path]:
        parts = [child for child in _children(folder) if (child / "partition").exists()]
        return sorted(parts, key=lambda part: _number(part / "partition"))

    def _partitions(self, folder: Path) -> Iterator[Partition]:
        for part in self._parts(folder):
            found = self._udev(part)
            size = _number(part / "size") * SECTOR_BYTES
            system, label = found.get("ID_FS_TYPE", ""), found.get("ID_FS_LABEL", "")
            yield Partition(part.name, size, system, label)

    def _udev(self, folder: Path) -> dict[str, str]:
        lines = _text(self._root / "run/udev/data" / f"b{_text(folder / 'dev')}").splitlines()
        pairs = (line[2:].partition("=") for line in lines if line.startswith("E:"))
        return {key: value for key, _, value in pairs}


def _children(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    """A small file's text without blanks around it; "" where it is not there."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _number(path: Path) -> int:
    text = _text(path)
    return int(text) if text.isdecimal() else 0


def _unescaped(text: str) -> str:
    return _OCTAL.sub(lambda match: chr(int(match[1], 8)), text)


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
