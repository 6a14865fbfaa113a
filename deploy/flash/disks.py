"""What lsblk(8) tells of a disk, and which ones are never written, each with its reason."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deploy.errors import DeployError, printable
from deploy.run import run

Entry = dict[str, Any]
"""A device as `lsblk --json` shows it; `children` are its partitions and what lies upon them."""

_COLUMNS = "NAME,KNAME,PKNAME,TYPE,SIZE,RM,RO,VENDOR,MODEL,SERIAL,FSTYPE,LABEL,MOUNTPOINTS"
_SWAP = "[SWAP]"
# A disk under one of these is the one that the running system lives on.
_SYSTEM_MOUNTS = ("/", "/boot", "/boot/efi", "/boot/firmware", "/usr", "/var", "/etc", _SWAP)


def find(path: Path) -> Entry | None:
    """The disk at a path, checked; None when an image file is there instead.

    Raises `DeployError` for everything that is not a card in a reader, whole, writable and idle.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        hint = ""
        if isinstance(error, FileNotFoundError):
            hint = "; put the card in, and lsblk -o NAME,SIZE,MODEL,RM names it"
            if not path.is_relative_to("/dev"):
                hint = f"; to write a file, make it as large as the card: truncate -s 8G {path}"
        raise DeployError(f"{path}: {error.strerror or error}{hint}") from None
    if stat.S_ISREG(mode):
        shows_it = ["losetup", "--noheadings", "--output", "NAME", "--associated"]
        if loop := run([*shows_it, path.resolve()]).decode().split():
            raise DeployError(f"{path}: it is in use as {loop[0]}: sudo losetup -d {loop[0]}")
        return None
    if not stat.S_ISBLK(mode):
        raise DeployError(f"{path}: neither a disk nor an image file")
    said = run(["lsblk", "--json", "--bytes", "--all", "--output", _COLUMNS, path.absolute()])
    (disk,) = json.loads(said)["blockdevices"]
    if disk["type"] == "part":
        raise DeployError(f"{path}: a partition; name the whole disk, /dev/{disk['pkname']}")
    disk = completed(disk, Path("/sys/class/block") / disk["kname"])
    check(disk)
    return disk


def completed(disk: Entry, sysfs: Path) -> Entry:
    """A disk with what its folder in sysfs tells of a built-in slot, where lsblk is silent.

    There the kernel calls an SD card fixed, as it does eMMC, whose type is MMC.
    """
    kind, name = (_text(sysfs / "device" / file) for file in ("type", "name"))
    return {**disk, "rm": disk["rm"] or kind == "SD", "model": disk["model"] or name}


def check(disk: Entry) -> None:
    """Raises `DeployError` when the disk must not be written."""
    device, model = f"/dev/{disk['name']}", model_of(disk)
    for use, system in sorted(_uses(disk), key=lambda use: not use[1]):
        why = f"this machine runs on it ({use})" if system else f"in use: {use}"
        raise DeployError(f"{device}: {why}")
    if disk["type"] == "rom":
        raise DeployError(f"{device}: {model}: not a disk")
    if not disk["rm"]:
        raise DeployError(
            f"{device}: {model}, {shown_size(disk['size'])}, is a fixed disk (not removable); only"
            " cards are written"
        )
    if disk["size"] == 0:
        raise DeployError(f"{device}: no card in it")
    if disk["ro"]:
        raise DeployError(f"{device}: write-protected; look at the switch on the card's side")


def _uses(device: Entry) -> Iterator[tuple[str, bool]]:
    """Who works with a device or with what lies upon it, and whether this machine runs on it."""
    for point in filter(None, device["mountpoints"]):
        use = "is swap space" if point == _SWAP else f"is mounted on {point}"
        yield f"{device['name']} {use}", point in _SYSTEM_MOUNTS
    for child in device.get("children", ()):
        if child["type"] != "part":  # LVM, dm-crypt, RAID
            yield f"{device['name']} is held by {child['name']}", False
        yield from _uses(child)


def _text(path: Path) -> str:
    """A small file's text without blanks around it; "" where it is not there."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def model_of(disk: Entry) -> str:
    """Vendor and model, as far as they are known."""
    return " ".join(" ".join((disk["vendor"] or "", disk["model"] or "")).split()) or "unknown"


def check_size(path: Path, size: int, needed: int) -> None:
    """Raises `DeployError` when the image does not fit."""
    if size < needed:
        raise DeployError(
            f"{path}: {size} bytes ({shown_size(size)}); the image needs {needed}"
            f" ({shown_size(needed)})"
        )


def describe(path: Path, disk: Entry | None, size: int) -> str:
    """The disk in a few lines, so that a person can see whether it is the one they mean."""
    if disk is None:
        return f"{path}: image file, {shown_size(size)}"
    serial = disk["serial"] or "unknown"
    lines = [f"{path}: {model_of(disk)}, {shown_size(disk['size'])}, serial {serial}"]
    for part in disk.get("children", ()):
        found = f"{part['fstype'] or ''} {part['label'] or ''}"
        lines.append(f"  {part['name']}: {shown_size(part['size'])} {found}".rstrip())
    return "\n".join(map(printable, lines if lines[1:] else [*lines, "  no partitions"]))


def shown_size(size: int) -> str:
    """Bytes as a card's label says them: powers of ten."""
    value, unit = float(size), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if value >= 100 or unit == "B" else f"{value:.1f} {unit}"
