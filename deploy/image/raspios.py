"""A card for the Zero W out of a Raspberry Pi OS Lite image: the root changed in place, unmounted.

Debian's own armhf needs ARMv7, which the Zero W is not; Raspberry Pi OS has both its kernel and its
packages. Those of `boards/zerow.toml` that the base lacks are installed by its own apt, from its
own sources (`packages/base.py`): once, then from the cache. Not verified on hardware, nor with
Raspberry Pi OS itself, which was out of reach: it was tested with small images that have the layout
of the real one, and with a Debian armhf in its place.

The root partition is taken out, changed with debugfs, checked, and put into a card of the same
layout as the other boards'. The boot partition is made again from the base's files.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from deploy.errors import DeployError
from deploy.image import card, ext4, initrd, partitions, release, root
from deploy.image.card import Identifiers, building
from deploy.image.packages.base import add_packages, lay_over
from deploy.image.packages.board import Board
from deploy.image.partitions import FAT32_LBA, LINUX
from deploy.image.sparse import Range, cut_out, sha256
from deploy.image.tree import Tree
from deploy.run import run

_OS_RELEASE = "usr/lib/os-release"
_STATUS = "var/lib/dpkg/status"
# What Raspberry Pi OS, 32 bit, calls itself; its packages are built for ARMv6.
_ARMV6 = "raspbian"
_KERNEL, _KERNEL_SUFFIX = "kernel.img", "-rpi-v6"
# What of the root is looked at: accounts, units, the kernel's modules and what else the initrd has.
_WANTED = ("etc/", "usr/lib/systemd/system", "usr/lib/sysusers.d/")
_MODULES = "usr/lib/modules/"
_WANTED_FILES = (_OS_RELEASE, _STATUS, "usr/bin/busybox")
# Its first boot's and its own first root.
_NOT_TAKEN = ("config.txt", "cmdline.txt", "issue.txt", "initramfs*", "firstrun.sh", "userconf*",
              "custom.toml", "user-data", "meta-data", "network-config")  # fmt: skip
# Room for what the file system itself needs when files are added.
_SPARE_BYTES = 16 << 20


def build(
    image: Path,
    board: Board,
    base: Path,
    site: Path | None,
    cache_folder: Path,
    checkout: Path,
    epoch: int,
    log: card.Log = lambda line: None,
) -> None:
    """Builds the image as `card.build` does, but of a `base`.

    That is a Raspberry Pi OS Lite image, 32 bit, trixie; `.xz` is unpacked. What is installed into
    it is kept in `cache_folder`; `epoch` is the time of everything that is ours. Raises
    `DeployError` for a base that is not what it should be, with what it is.
    """
    card.check_epoch(epoch)
    with building(image) as work:
        log(f"taking {base.name} apart")
        boot_place, root_place = work / "base-boot", work / "root"
        _take_apart(base, work, boot_place, root_place)
        contents = work / "contents"
        contents.mkdir()
        run(["e2fsck", "-fp", root_place], ok=(0, 1), env=ext4.clock(epoch))
        before = ext4.read_tree(root_place, _is_wanted, contents)
        missing = _check(base, before, board)
        tree = before.copy()
        digest_of_base = sha256(base)
        if missing:
            log(f"{len(missing)} packages that the base lacks (emulated, the first time)")
            added = add_packages(board, digest_of_base, root_place, before, missing, cache_folder)
            lay_over(tree, Tree.from_tar(added))
        packages = card.packages_of(tree)
        firmware = release.build(checkout, site, board.machine, board.python, epoch)
        units = root.customise(tree, checkout, board.name, firmware, epoch)
        ours = tree.changed(before)
        new = Identifiers(board.name.encode(), digest_of_base.encode(), ours.digest(epoch))
        first = initrd.build(tree, _kernel_release(base, tree))
        log(f"root: {len(ours)} files and folders of ours, {len(units)} units enabled")
        _grow(root_place, ours, epoch)
        run(["tune2fs", "-L", card.ROOT_LABEL, root_place], env=ext4.clock(epoch))
        ext4.fill(root_place, tree, epoch, before)
        where = f"UUID={ext4.facts(root_place)['Filesystem UUID']}"
        files = _boot_files(base, boot_place, work / "base-files")
        front = card.boot_contents(board.name, _KERNEL, board.machine, files, first, where)
        log("boot and data partition, image, block map and checksums")
        told = card.BuildRecord(board.name, checkout, epoch, packages, site, units, base)
        card.finish(work / image.name, front, root_place, new, told)


def _take_apart(base: Path, work: Path, boot_place: Path, root_place: Path) -> None:
    if not base.is_file():
        raise DeployError(f"{base}: no such image")
    whole = base
    if base.suffix == ".xz":
        whole = work / "base"
        shutil.copy(base, work / "base.xz")
        run(["xz", "-d", work / "base.xz"])
    try:
        found = partitions.table(whole)
    except DeployError:
        raise DeployError(f"{base}: no partition table of a Raspberry Pi OS image") from None
    kinds = [part["type"] for part in found]
    if kinds != [FAT32_LBA, LINUX]:
        wants = f"{FAT32_LBA} and {LINUX}"
        raise DeployError(f"{base}: partitions of type {', '.join(kinds)}; expected {wants}")
    for part, place in zip(found, (boot_place, root_place), strict=True):
        end = part["start"] + part["size"]
        if end > whole.stat().st_size:
            raise DeployError(f"{base}: cut at {whole.stat().st_size} of {end} bytes")
        cut_out(whole, Range(part["start"], end), place)
    if whole is not base:
        whole.unlink()


def _is_wanted(path: str) -> bool:
    if path.startswith(_MODULES):
        return path.split("/")[3].endswith(_KERNEL_SUFFIX)  # not the other boards' kernels
    return path.startswith(_WANTED) or path in _WANTED_FILES


def _check(base: Path, tree: Tree, board: Board) -> list[str]:
    """Refuses another system than the board's; gives the packages that it lacks, sorted."""
    if _OS_RELEASE not in tree or _STATUS not in tree:
        raise DeployError(f"{base}: no /{_OS_RELEASE} and /{_STATUS} in it")
    lines = tree.read(_OS_RELEASE).decode("utf-8", "replace").splitlines()
    says = {key: value.strip('"') for key, _, value in (line.partition("=") for line in lines)}
    codename = says.get("VERSION_CODENAME", "")
    if codename != board.suite:
        raise DeployError(f"{base}: of '{codename}'; expected '{board.suite}'")
    packages = card.packages_of(tree)
    architectures = {row[2] for row in packages if row[0] == "base-files"}
    if architectures != {board.architecture}:
        found = ", ".join(architectures) or "no package base-files"
        raise DeployError(f"{base}: for {found}; expected {board.architecture}")
    missing = sorted(set(board.package_names) - {row[0] for row in packages})
    if missing and says.get("ID") != _ARMV6:
        # Nobody but Raspberry Pi OS has packages for the Zero W's processor.
        raise DeployError(f"{base}: install there first: {' '.join(missing)}")
    return missing


def _kernel_release(base: Path, tree: Tree) -> str:
    names = {path.split("/")[3] for path, _ in tree.below("usr/lib/modules")}
    found = sorted(name for name in names if name.endswith(_KERNEL_SUFFIX))
    if len(found) != 1:
        there = ", ".join(sorted(names)) or "none"
        raise DeployError(f"{base}: one kernel *{_KERNEL_SUFFIX} expected, there: {there}")
    return found[0]


def _grow(place: Path, added: Tree, epoch: int) -> None:
    """Makes room in the file system for entries, by their bytes and their number."""
    facts = {name: int(value) for name, value in ext4.facts(place).items() if value.isdigit()}
    block = facts["Block size"]
    lacking = ext4.bytes_needed(added) + _SPARE_BYTES - facts["Free blocks"] * block
    # Inodes come with whole groups of blocks.
    groups = -(-(len(added) - facts["Free inodes"]) // facts["Inodes per group"])
    lacking = max(lacking, groups * facts["Blocks per group"] * block)
    if lacking > 0:
        with open(place, "r+b") as file:
            file.truncate(partitions.align(place.stat().st_size + lacking))
        run(["resize2fs", place], env=ext4.clock(epoch))


def _boot_files(base: Path, place: Path, folder: Path) -> Tree:
    folder.mkdir()
    run(["mcopy", "-s", "-n", "-i", place, "::*", folder])
    tree = Tree()
    tree.take(folder, release.folder_files(folder))
    for path, _ in list(tree.items()):
        if any(Path(path).match(pattern) for pattern in _NOT_TAKEN):
            tree.remove(path)
    if _KERNEL not in tree:
        raise DeployError(f"{base}: no {_KERNEL} on its boot partition")
    return tree
