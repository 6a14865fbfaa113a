"""What the kernel tells of a disk: everything that the flasher knows of a device is read here.

From sysfs, /proc and udev's database under one root folder, so that a recorded tree can stand for
a machine: https://docs.kernel.org/admin-guide/abi-stable-files.html, `proc_pid_mountinfo(5)`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
