"""A FAT32 file system in a file, filled from a tree with mtools: no mounting, no clock."""

from __future__ import annotations

import os
import struct
import tempfile
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.sparse import Range, data_ranges
from deploy.image.tree import Tree
from deploy.run import run

_SECTOR_BYTES = 512
_CLUSTER_BYTES = 512
# FAT counts time from 1980; its year has 7 bits.
FIRST_SECOND = 315_532_800
LAST_SECOND = 4_354_819_199


def make(image: Path, size: int, tree: Tree, label: str, serial: int, epoch: int) -> None:
    """Makes a file system of `size` bytes with the tree's files; owners and modes are lost.

    `label` has up to 11 capital letters, `serial` 32 bits; `epoch` is the time of everything in it,
    s since 1970, in 1980 to 2107. Raises `DeployError` when the tree does not fit or has a link,
    which FAT does not know, or a tool fails.
    """
    needed = bytes_needed(tree)
    if size < needed:
        raise DeployError(f"{label}: contents need {needed >> 20} MiB and get {size >> 20} MiB")
    image.unlink(missing_ok=True)
    with open(image, "wb") as file:
        file.truncate(size)
    clock = {"SOURCE_DATE_EPOCH": str(epoch), "TZ": "UTC", "MTOOLS_SKIP_CHECK": "1"}
    # --invariant sets a serial number of its own, so it stands before ours.
    identity = ["--invariant", "-i", f"{serial:08x}", "-n", label]
    cluster = str(_CLUSTER_BYTES // _SECTOR_BYTES)
    run(["mkfs.vfat", "-F", "32", "-s", cluster, *identity, image], env=clock)
    with tempfile.TemporaryDirectory(dir=image.parent, prefix=".boot-") as work:
        stage = Path(work)
        files: dict[str, list[Path]] = {}
        for path, entry in tree.items():
            place = stage / path
            if entry.kind == "folder":
                place.mkdir()
                run(["mmd", "-i", image, f"::/{path}"], env=clock)
            elif entry.kind == "file":
                place.write_bytes(entry.content.read())
                os.utime(place, (epoch, epoch))
                files.setdefault(path.rpartition("/")[0], []).append(place)
            else:
                raise DeployError(f"{label}: {path}: FAT holds no links")
        for folder, places in files.items():
            run(["mcopy", "-m", "-i", image, *places, f"::/{folder}"], env=clock)


def bytes_needed(tree: Tree) -> int:
    """What a file system for this tree must have at least, in whole MiB; FAT32's own least too."""
    clusters = sum(1 + -(-entry.content.size // _CLUSTER_BYTES) for _, entry in tree.items())
    # Less than 65525 clusters are FAT16 by definition; each takes 4 bytes in both tables.
    needed = max(clusters, 65_600) * (_CLUSTER_BYTES + 8) + 32 * _SECTOR_BYTES
    return -(-needed // (1 << 20)) << 20


def used_ranges(image: Path) -> list[Range]:
    """The stretches that matter on a card: both tables, free entries too, and what is stored."""
    with open(image, "rb") as file:
        boot = file.read(_SECTOR_BYTES)
    (sector,) = struct.unpack_from("<H", boot, 11)
    (reserved,) = struct.unpack_from("<H", boot, 14)
    tables, (table,) = boot[16], struct.unpack_from("<I", boot, 36)
    return [Range(0, (reserved + tables * table) * sector), *data_ranges(image)]
