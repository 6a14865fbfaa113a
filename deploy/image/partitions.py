"""The card's partitions, put together in one file with sfdisk: no loop device, nothing mounted."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.errors import DeployError
from deploy.image.sparse import Range, copy_into, merged
from deploy.run import run

SECTOR_BYTES = 512
# Partitions begin at whole erase units of a card, which has none bigger than this.
ALIGN_BYTES = 4 << 20
# The unit of a block map; ext4's block.
BLOCK_BYTES = 4096

FAT32_LBA = "c"
LINUX = "83"


@dataclass(frozen=True)
class Partition:
    """A partition's file system in a file, and which of its stretches matter."""

    name: str
    type: str
    source: Path
    used: list[Range]

    @property
    def size(self) -> int:
        return self.source.stat().st_size


def align(size: int) -> int:
    """The next size at which a partition may end."""
    return -(-size // ALIGN_BYTES) * ALIGN_BYTES


def power_of_two(size: int) -> int:
    """The next power of two, the only sizes that QEMU's SD card takes."""
    return 1 << (size - 1).bit_length()


def assemble(image: Path, partitions: list[Partition], disk: int, size: int | None = None) -> None:
    """Writes the table and at most 4 partitions, in order, into a new file.

    Each begins at a multiple of `ALIGN_BYTES`; holes are where nothing that matters lies. `disk` is
    the disk's number, 32 bits and not 0; `size` is the image's in bytes (default: to the last
    partition's end). Raises `DeployError` when they do not fit into it.
    """
    starts: list[int] = []
    end = ALIGN_BYTES
    for partition in partitions:
        starts.append(end)
        end = align(end + partition.size)
    if size is None:
        size = end
    if size < end:
        raise DeployError(f"{image.name}: {size >> 20} MiB, the contents need {end >> 20} MiB")
    image.unlink(missing_ok=True)
    with open(image, "wb") as file:
        file.truncate(size)
    lines = ["label: dos", f"label-id: 0x{disk:08x}", "unit: sectors"]
    for start, partition in zip(starts, partitions, strict=True):
        sectors = f"start={start // SECTOR_BYTES}, size={partition.size // SECTOR_BYTES}"
        active = ", bootable" if partition.type == FAT32_LBA else ""
        lines.append(f"{sectors}, type={partition.type}{active}")
    run(["sfdisk", "--quiet", "--no-reread", image], input="\n".join(lines).encode())
    for start, partition in zip(starts, partitions, strict=True):
        used = merged(partition.used, BLOCK_BYTES, partition.size)
        copy_into(partition.source, used, image, start)


def table(image: Path) -> list[dict[str, Any]]:
    """The partitions of an image: start and size in bytes, type, uuid, as sfdisk reads them.

    Raises:
        DeployError: no partition table of the DOS kind.
    """
    document = json.loads(run(["sfdisk", "--json", image]))["partitiontable"]
    if document["label"] != "dos":
        raise DeployError(f"{image}: a partition table of kind {document['label']}, not dos")
    return [
        {
            "start": part["start"] * SECTOR_BYTES,
            "size": part["size"] * SECTOR_BYTES,
            "type": part["type"],
            "uuid": f"{document['id'].removeprefix('0x')}-{number:02d}",
        }
        for number, part in enumerate(document["partitions"], start=1)
    ]
