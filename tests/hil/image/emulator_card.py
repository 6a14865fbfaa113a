"""What is done with a card image beside booting it: its boot files, a working copy, its health.

The emulated board has no boot ROM: its part, to read `config.txt` and `cmdline.txt` and to load
what they name, is played here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.partitions import SECTOR_BYTES, power_of_two, table
from deploy.image.sparse import Range, cut_out, sha256
from deploy.run import run

BOOT, ROOT, DATA = 1, 2, 3
_DEFAULTS = {"kernel": "kernel8.img", "device_tree": "bcm2837-rpi-3-b.dtb", "initramfs": ""}


@dataclass(frozen=True)
class Boot:
    """What the boot ROM and the Pi's firmware would hand to the processor."""

    kernel: Path
    device_tree: Path
    initrd: Path | None
    command_line: str


@dataclass(frozen=True)
class Health:
    """A card's file systems after a power cut; `problems` is empty when all is well.

    `replayed` tells whether the data partition's journal had something to play back.
    """

    problems: tuple[str, ...]
    replayed: bool


def working_copy(image: Path, copy: Path) -> None:
    """Copies a card image and enlarges the copy as a larger card would be.

    An emulated SD card's size is a power of two, as real ones' nearly are; the copy has at least
    an eighth more than the image, for the data partition to grow into. Holes stay holes.
    """
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.unlink(missing_ok=True)
    run(["cp", "--sparse=always", image, copy])
    size = image.stat().st_size
    with copy.open("r+b") as file:
        file.truncate(power_of_two(size + size // 8))


def boot_files(image: Path, folder: Path) -> Boot:
    """Takes kernel, device tree, initrd and kernel line out of the card's boot partition.

    Raises:
        DeployError: the card is not bootable, with the name of what is missing.
    """
    offset = partition(image, BOOT).start
    folder.mkdir(parents=True, exist_ok=True)

    def take(name: str) -> Path:
        target = folder / Path(name).name
        target.unlink(missing_ok=True)
        try:
            run(["mcopy", "-n", "-i", f"{image}@@{offset}", f"::{name}", target])
        except DeployError as error:
            raise DeployError(f"{image}: not bootable, no '{name}': {error}") from None
        return target

    named = _config(take("config.txt").read_text("utf-8", "replace"))
    return Boot(
        kernel=take(named["kernel"]),
        device_tree=take(named["device_tree"]),
        initrd=take(named["initramfs"]) if named["initramfs"] else None,
        command_line=" ".join(take("cmdline.txt").read_text("ascii", "replace").split()),
    )


def partition(image: Path, number: int) -> Range:
    """Where a partition lies, in bytes."""
    if not image.is_file():
        raise DeployError(f"{image}: no such card image")
    entries = table(image)
    if not 0 < number <= len(entries):
        raise DeployError(f"{image}: has no partition {number}")
    entry = entries[number - 1]
    return Range(entry["start"], entry["start"] + entry["size"])


def digest(image: Path, number: int) -> str:
    """The SHA-256 of a partition's bytes."""
    return sha256(image, partition(image, number))


def health(image: Path, folder: Path, root_digest: str) -> Health:
    """Looks at a card whose power was cut, on copies: the card itself is left as it is.

    Root must have not one byte changed: it is mounted read-only. Data gets its journal played back,
    as each mount does, and must then have nothing for `e2fsck -f` to fix. The boot partition has
    no journal: `fsck.vfat -n` must find nothing but the mark that it was not unmounted.
    """
    problems = []
    if digest(image, ROOT) != root_digest:
        problems.append("root: was written to")
    folder.mkdir(parents=True, exist_ok=True)
    data, boot = folder / "data.ext4", folder / "boot.vfat"
    cut_out(image, partition(image, DATA), data)
    cut_out(image, partition(image, BOOT), boot)
    replayed = b"needs_recovery" in run(["dumpe2fs", "-h", data])
    try:
        run(["e2fsck", "-p", data], ok=(0, 1))
        run(["e2fsck", "-f", "-n", data])
    except DeployError as error:
        problems.append(f"data: {error}")
    _clear_mark(boot)
    try:
        run(["fsck.vfat", "-n", boot])
    except DeployError:
        said = run(["fsck.vfat", "-n", boot], ok=(1,)).decode(errors="replace").splitlines()
        problems.append(f"boot: {'; '.join(line.strip() for line in said[1:-1] if line.strip())}")
    for copy in (data, boot):
        copy.unlink()
    return Health(tuple(problems), replayed)


def _clear_mark(boot: Path) -> None:
    """Takes the mark of a FAT file system that is in use off: it says no more than that.

    Linux keeps it in bit 0 of the boot sector's byte that Windows NT reserved, 65 bytes into
    FAT32's, 37 into FAT16's; FAT32 has no count of sectors a table at 22.
    """
    with boot.open("r+b") as file:
        sector = file.read(SECTOR_BYTES)
        where = 65 if sector[22:24] == b"\0\0" else 37
        file.seek(where)
        file.write(bytes([sector[where] & ~1]))


def _config(text: str) -> dict[str, str]:
    """The three names that `config.txt` gives (raspberrypi.com, "config.txt"); no filters."""
    named = dict(_DEFAULTS)
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        key, equals, value = line.partition("=")
        if equals and key.strip() in named:
            named[key.strip()] = value.strip()
        elif line.startswith("initramfs "):
            named["initramfs"] = line.split()[1]
    return named
