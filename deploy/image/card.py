"""Puts a card together: root, boot and data partition, the image, its manifest and checksum.

Everything is made beside the image in a folder of its own and renamed at the end, the image last:
what lies under the final name is whole, with the files that describe it.

Words of config.txt are the Raspberry Pi's (raspberrypi.com, "config.txt"); the emulator plays the
board's first stages and reads the same file.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.errors import DeployError
from deploy.image import ext4, fat, initrd, partitions, release, root
from deploy.image.packages.board import Board
from deploy.image.packages.cache import workshop
from deploy.image.packages.kernel import Kernel
from deploy.image.partitions import FAT32_LBA, LINUX, Partition, align, power_of_two, table
from deploy.image.release import folder_files, utc
from deploy.image.sparse import Range, sha256
from deploy.image.tree import Tree
from deploy.provisioning.model import Provisioning, Wifi
from deploy.provisioning.text import render
from deploy.run import run

BOOT_LABEL, ROOT_LABEL, DATA_LABEL = "BLIMPBOOT", "blimp-root", "blimp-data"
_INITRD = "initrd.img"

# Started again 10 s after a kernel that gives up; said on the screen, if any, and on no UART: that
# is the autopilot's.
# Raspberry Pi's firmware switches the accounting off that MemoryMax= needs.
_KERNEL_LINE = "rootfstype=ext4 ro rootwait panic=10 fsck.repair=yes cgroup_enable=memory"
_CAMERA_OF_QEMU = " modules_load=vivid"

_CONFIG = """\
# What the board starts with. A payload is told about its network in blimp/, not here.
kernel={kernel}
initramfs {initrd} followkernel
{more}\
disable_splash=1
boot_delay=0

# Camera and gauge.
camera_auto_detect=1
dtparam=i2c_arm=on

# The autopilot has the real UART: Bluetooth would take it.
enable_uart=1
dtoverlay=disable-bt

# A system that hangs is started again.
dtparam=watchdog=on
"""

_README = """\
The folder of this payload.

1. Copy blimp-example.toml to blimp.toml and write down there the payload's name and its Wi-Fi.
2. Put the folder certificates/ that `blimp keys payload NAME` made beside it.
3. Put the card into the payload and give it power. It takes the secrets out of this folder, and
   STATUS.txt says what came of it.

`make flash` does 1 and 2 by itself.
"""


def boot_contents(
    board: str, kernel: str, machine: str, tree: Tree, initrd: bytes, root: str
) -> Tree:
    """Adds what is ours to the partition's files, which are kernel and board's firmware, in place.

    `kernel` names the kernel's file in the tree, `machine` is as `uname -m` says there, `root` as
    the kernel's line names it.
    """
    more, camera = "arm_64bit=1\n" if machine == "aarch64" else "", ""
    if board == "qemu":
        more, camera = more + "device_tree=bcm2837-rpi-3-b.dtb\n", _CAMERA_OF_QEMU
    tree.write("config.txt", _CONFIG.format(kernel=kernel, initrd=_INITRD, more=more))
    tree.write("cmdline.txt", f"console=tty1{camera} root={root} {_KERNEL_LINE}\n")
    tree.write(_INITRD, initrd)
    tree.folder("blimp")
    example = Provisioning("blimp-1", Wifi(b"name of the network", "DE", "its password"))
    for name, text in (("blimp-example.toml", render(example)), ("README.txt", _README)):
        # Line ends that the simplest editor of any laptop shows as such.
        tree.write(f"blimp/{name}", text.replace("\n", "\r\n"))
    return tree


DESCRIPTIONS = (".bmap", ".manifest.json", ".sha256")
Log = Callable[[str], None]
_MIB = 1 << 20
DATA_BYTES = 64 * _MIB
# The emulator takes only cards of a power of two; a real one's boot partition has room for the
# kernels of later images, since its size cannot change on a card that is in use.
BOOT_BYTES = {"qemu": 64 * _MIB}
REAL_BOOT_BYTES = 256 * _MIB

_NAMESPACE = uuid.UUID("9b5d3f1c-6a0e-4c57-9d0b-0f3a3c6b7a51")


class Identifiers:
    """Identifiers that follow from what is on the card: another content, another card."""

    def __init__(self, *inputs: bytes) -> None:
        self._seed = hashlib.sha256(b"".join(inputs)).hexdigest()

    def uuid(self, name: str) -> uuid.UUID:
        return uuid.uuid5(_NAMESPACE, f"{self._seed} {name}")

    def number(self, name: str) -> int:
        """32 bits, not 0."""
        return self.uuid(name).int & 0xFFFFFFFF or 1


def build(
    image: Path,
    board: Board,
    kernel: Kernel,
    rootfs: Path,
    site: Path | None,
    checkout: Path,
    epoch: int,
    compile: Callable[[Path, str], None] | None = None,
    log: Log = lambda line: None,
) -> None:
    """Builds the image with `.bmap`, `.manifest.json` and `.sha256` beside it.

    Args:
        image: the final name; what is there stays until the new one is whole.
        board: one with a kernel of its own, which is `kernel`.
        rootfs: the packages' root, an uncompressed tar.
        site: a folder of unpacked wheels; None: none are needed.
        checkout: of this project, with git.
        epoch: the time of everything in it that is not older, s since 1970.
        compile: puts byte code beside all Python in a folder, which will lie at a path on the card;
            None: the card compiles at each start.
        log: takes a line of progress.

    Raises:
        DeployError: an ingredient is missing or broken, something does not fit, a tool fails.
    """
    check_epoch(epoch)
    with building(image) as work:
        log("reading the packages' root")
        tree = Tree.from_tar(rootfs)
        modules = f"usr/lib/modules/{kernel.version}"
        if not (kernel.root / modules / "modules.dep").is_file():
            raise DeployError(f"{kernel.root}/{modules}: no modules.dep in it")
        tree.take(kernel.root, [f"{modules}/{n}" for n in folder_files(kernel.root / modules)])
        firmware = release.build(checkout, site, board.machine, board.python, epoch)
        units = root.customise(tree, checkout, board.name, firmware, epoch)
        if compile is not None:
            log("byte code of the card's programs")
            root.add_byte_code(tree, compile)
        new = Identifiers(board.name.encode(), tree.digest(epoch))
        log(f"root: {len(tree)} files, {len(units)} units enabled")
        first = initrd.build(tree, kernel.version)
        files = Tree()
        files.take(kernel.boot, folder_files(kernel.boot))
        if kernel.image not in files:
            raise DeployError(f"{kernel.boot}: no kernel '{kernel.image}' in it")
        where = f"UUID={new.uuid('root')}"
        front = boot_contents(board.name, kernel.image, board.machine, files, first, where)
        log("root partition")
        place = work / "root"
        size = align(ext4.bytes_needed(tree))
        ext4.make(place, size, tree, ROOT_LABEL, new.uuid("root"), epoch)
        log("boot and data partition, image, block map and checksums")
        packages = packages_of(tree)
        told = BuildRecord(board.name, checkout, epoch, packages, site, units)
        finish(work / image.name, front, place, new, told)


def finish(image: Path, front: Tree, root_place: Path, new: Identifiers, told: BuildRecord) -> None:
    """Puts an image together from a boot partition's files and a root partition's file system.

    Adds the data partition, empty: the card makes its folders and grows it. Writes block map,
    checksum and manifest, too.
    """
    board, epoch = told.board, told.epoch
    boot_place, data_place = image.with_name("boot"), image.with_name("data")
    size = BOOT_BYTES.get(board, REAL_BOOT_BYTES)
    fat.make(boot_place, size, front, BOOT_LABEL, new.number("boot"), epoch)
    data = new.uuid("data")
    ext4.make(data_place, DATA_BYTES, Tree(), DATA_LABEL, data, epoch, journal=True)
    layout = [
        Partition("boot", FAT32_LBA, boot_place, fat.used_ranges(boot_place)),
        Partition("root", LINUX, root_place, ext4.used_ranges(root_place)),
        Partition("data", LINUX, data_place, ext4.used_ranges(data_place)),
    ]
    total = partitions.ALIGN_BYTES + sum(align(part.size) for part in layout)
    whole = power_of_two(total) if board == "qemu" else None
    partitions.assemble(image, layout, new.number("disk"), whole)
    run(["bmaptool", "create", "-o", beside(image, ".bmap"), image])
    digest = sha256(image)
    beside(image, ".sha256").write_text(f"{digest}  {image.name}\n")
    write(image, beside(image, ".manifest.json"), digest, told)


def check_epoch(epoch: int) -> None:
    """Refuses a time that FAT cannot tell."""
    if not fat.FIRST_SECOND <= epoch <= fat.LAST_SECOND:
        raise DeployError(f"--epoch {epoch}: allowed: {fat.FIRST_SECOND} to {fat.LAST_SECOND}")


@contextlib.contextmanager
def building(image: Path) -> Iterator[Path]:
    """A folder for the work on an image; at the end, what describes it and it go into place.

    One build at a time in a folder: what an earlier one that was killed left there is removed.
    """
    try:
        image.parent.mkdir(parents=True, exist_ok=True)
        folder = os.open(image.parent, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise DeployError(f"{image}: {error.strerror or error}") from None
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DeployError(f"{image.parent}: another image is being built there") from None
        with workshop(image) as work:
            yield work
            # The old image goes before its description does: no image beside another's.
            image.unlink(missing_ok=True)
            for suffix in (*DESCRIPTIONS, ""):
                beside(work / image.name, suffix).replace(beside(image, suffix))
    except OSError as error:
        raise DeployError(f"{error.filename or image}: {error.strerror or error}") from None
    finally:
        os.close(folder)


def beside(image: Path, suffix: str) -> Path:
    """The file that describes an image: `.bmap`, `.manifest.json` or `.sha256` behind its name."""
    return image.with_name(image.name + suffix)


SCHEMA = "blimp.image/1"
_PARTITIONS = ("boot", "root", "data")
_NUMBER = re.compile(r"\d\.\d")

# The tools whose work is in the bytes, and how each says its version.
_TOOLS = {
    "debugfs": ["debugfs", "-V"],
    "mcopy": ["mcopy", "--version"],
    "mke2fs": ["mke2fs", "-V"],
    # mkfs.vfat says its version only at work; its sister of the same package always.
    "mkfs.vfat": ["fsck.vfat", "-n", "/dev/null"],
    "sfdisk": ["sfdisk", "--version"],
}


@dataclass(frozen=True)
class BuildRecord:
    """What an image does not tell by itself.

    Attributes:
        board, checkout, epoch: what it was made for, of and at.
        packages: name, version, architecture of what is installed.
        site: the unpacked wheels.
        units: that are enabled.
        base: the image that it was made from, if any.
    """

    board: str
    checkout: Path
    epoch: int
    packages: Sequence[tuple[str, str, str]]
    site: Path | None
    units: Sequence[str]
    base: Path | None = None


def write(image: Path, to: Path, digest: str, told: BuildRecord) -> None:
    """Writes the manifest of a finished image, whose SHA-256 in hex is `digest`."""
    partitions = []
    for name, part in zip(_PARTITIONS, table(image), strict=True):
        span = Range(part["start"], part["start"] + part["size"])
        partitions.append({"name": name, **part, "sha256": sha256(image, span)})
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "board": told.board,
        "version": release.version(told.checkout),
        "revision": release.revision(told.checkout),
        "epoch": told.epoch,
        "made": utc(told.epoch),
        "image": {"size": image.stat().st_size, "sha256": digest},
        "partitions": partitions,
        "units": list(told.units),
        "packages": [
            {"name": name, "version": version, "architecture": architecture}
            for name, version, architecture in told.packages
        ],
        "wheels": wheels(told.site),
        "wheels_sha256": _all_files(told.site),
        "tools": {name: _version(words) for name, words in _TOOLS.items()},
    }
    if told.base is not None:
        document["base"] = {"name": told.base.name, "sha256": sha256(told.base)}
    to.write_text(json.dumps(document, indent=2) + "\n")


def packages_of(tree: Tree) -> list[tuple[str, str, str]]:
    """Name, version and architecture of what dpkg calls installed in a tree, if it was there."""
    path = "var/lib/dpkg/status"
    status = tree.read(path).decode("utf-8", "replace") if path in tree else ""
    found = []
    for stanza in status.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in stanza.splitlines() if ": " in line[1:])
        if fields.get("Status", "").endswith(" installed"):
            found.append((fields["Package"], fields["Version"], fields["Architecture"]))
    return sorted(found)


def wheels(site: Path | None) -> list[dict[str, str]]:
    """Name, version and the hash of its list of files (RECORD) of each unpacked wheel."""
    result = []
    for info in sorted(site.glob("*.dist-info")) if site is not None else ():
        name, _, version = info.name.removesuffix(".dist-info").rpartition("-")
        record = info / "RECORD"
        digest = sha256(record) if record.is_file() else ""
        result.append({"name": name, "version": version, "record_sha256": digest})
    return result


def _all_files(site: Path | None) -> str:
    """One hash over all files of the wheels, as of what `sha256sum` prints for them."""
    whole = hashlib.sha256()
    if site is not None:
        for path in folder_files(site):
            whole.update(f"{sha256(site / path)}  {path}\n".encode())
    return whole.hexdigest()


def _version(words: list[str]) -> str:
    said = run(words, merge=True, ok=(0, 1)).decode(errors="replace")
    return next((line.strip() for line in said.splitlines() if _NUMBER.search(line)), "")
