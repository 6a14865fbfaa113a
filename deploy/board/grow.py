"""Gives the data partition the rest of the card: `python3 -m deploy.board.grow`, at each boot.

The image's last partition is small; a card is as large as it is. One sector, the partition table
(MBR), is written, so that power may go at any time: it is the old table or the new one. The file
system follows when it is mounted (systemd's growfs, online and journalled).

It runs before udev: that takes a written partition table for a new disk, announces all partitions
again, and systemd then unmounts what it had just mounted.
"""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path
from typing import NamedTuple

from deploy.errors import DeployError

LABEL = b"blimp-data"
SECTOR = 512
ALIGN_SECTORS = 4 * 1024 * 1024 // SECTOR  # a card's erase blocks are this large or a part of it
_TABLE, _ENTRY, _ENTRIES = 446, struct.Struct("<B3sB3sII"), 4
_SIGNATURE = b"\x55\xaa"
_LINUX, _GPT = 0x83, 0xEE
_EXTENDED = frozenset({0x05, 0x0F, 0x85})
_MOST_SECTORS = 0xFFFFFFFF  # an entry's numbers have 32 bits: 2 TiB
_NO_CHS = b"\xfe\xff\xff"  # beyond what cylinders, heads and sectors can say


class Partition(NamedTuple):
    """An entry of the table; `start` and `size` in sectors."""

    number: int
    kind: int
    start: int
    size: int

    @property
    def end(self) -> int:
        return self.start + self.size


def partitions(sector: bytes) -> list[Partition]:
    """The used entries of a partition table; raises `DeployError` when it is none of ours."""
    if len(sector) != SECTOR or sector[-2:] != _SIGNATURE:
        raise DeployError("no partition table (MBR) in the first sector")
    found = []
    for index in range(_ENTRIES):
        _, _, kind, _, start, size = _ENTRY.unpack_from(sector, _TABLE + index * _ENTRY.size)
        if kind == 0 and size == 0:
            continue
        if kind == _GPT:
            raise DeployError("the partition table is a GPT; expected an MBR")
        if kind in _EXTENDED:
            raise DeployError(f"partition {index + 1} is an extended one; expected primary ones")
        if start == 0 or size == 0:
            raise DeployError(f"partition {index + 1} has start {start} and size {size} sectors")
        found.append(Partition(index + 1, kind, start, size))
    return found


def grown(sector: bytes, number: int, sectors: int) -> bytes | None:
    """The table with the last partition up to the end of the card; None: it is there already.

    `sector` is the first one, 512 bytes, `sectors` the card's size. Its end is a multiple of 4 MiB.
    Raises `DeployError` when partition `number` is not a Linux one, not the last, overlaps another
    or leaves the card.
    """
    table = partitions(sector)
    ours = next((entry for entry in table if entry.number == number), None)
    if ours is None:
        raise DeployError(f"there is no partition {number}")
    if ours.kind != _LINUX:
        raise DeployError(f"partition {number} is of type {ours.kind:#04x}; expected {_LINUX:#04x}")
    for other in table:
        if other.end > sectors:
            raise DeployError(
                f"partition {other.number} ends at sector {other.end}, the card at {sectors}"
            )
        if other != ours and other.end > ours.start:
            raise DeployError(f"partition {other.number} lies behind or over partition {number}")
    end = min(sectors, _MOST_SECTORS) // ALIGN_SECTORS * ALIGN_SECTORS
    if end <= ours.end:
        return None
    at = _TABLE + (number - 1) * _ENTRY.size
    boot, first, kind, _, start, _ = _ENTRY.unpack_from(sector, at)
    entry = _ENTRY.pack(boot, first, kind, _NO_CHS, start, end - start)
    return sector[:at] + entry + sector[at + _ENTRY.size :]


def grow(disk: Path, number: int) -> bool:
    """Enlarges a partition on a disk or image file; False when it had all the room already.

    Raises `DeployError`; then nothing was written.
    """
    try:
        with open(disk, "r+b", buffering=0) as file:
            sectors = file.seek(0, os.SEEK_END) // SECTOR
            file.seek(0)
            after = grown(file.read(SECTOR) or b"", number, sectors)
            if after is None:
                return False
            file.seek(0)
            file.write(after)
            os.fsync(file.fileno())
    except OSError as error:
        raise DeployError(f"{disk}: {error.strerror or error}") from None
    except DeployError as error:
        raise DeployError(f"{disk}: {error}") from None
    return True


def find(label: bytes = LABEL, root: Path = Path("/")) -> tuple[Path, int]:
    """The disk's device file and the number of the ext4 partition of that label.

    Raises `DeployError` when there is none, more than one, or its sectors have not 512 bytes.
    """
    found = []
    for entry in sorted((root / "sys/class/block").glob("*/partition")):
        folder = entry.parent.resolve()
        if _label(root / "dev" / folder.name) == label:
            found.append((folder, int(entry.read_text())))
    if len(found) != 1:
        raise DeployError(f"{len(found)} partitions are called {label.decode()}; expected one")
    folder, number = found[0]
    size = (folder.parent / "queue/logical_block_size").read_text().strip()
    if size != str(SECTOR):
        raise DeployError(f"{folder.name}: sectors of {size} bytes; expected {SECTOR}")
    return root / "dev" / folder.parent.name, number


def _label(partition: Path) -> bytes:
    """An ext4's label (Linux, fs/ext4/ext4.h: s_magic and s_volume_name); empty for none."""
    try:
        with open(partition, "rb", buffering=0) as file:
            block = os.pread(file.fileno(), 1024, 1024)
    except OSError:
        return b""
    return block[0x78:0x88].rstrip(b"\0") if block[0x38:0x3A] == b"\x53\xef" else b""


def main(root: Path = Path("/")) -> int:
    """Status 0 also where there was nothing to do, 2 when the table is none that we touch."""
    try:
        disk, number = find(root=root)
        if grow(disk, number):
            from deploy.run import run  # at the first boot only: each import costs a slow board

            # The kernel keeps the old size otherwise, as the root on the same card is in use.
            run(["partx", "--update", "--nr", str(number), disk], timeout_s=20)
            print(f"grow: partition {number} of {disk} has the rest of the card")
    except (DeployError, OSError, ValueError) as error:
        print(f"grow: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
