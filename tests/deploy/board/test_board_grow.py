"""The data partition gets the rest of the card: the table, on image files, and nothing strange."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import pytest

from deploy.board import grow
from deploy.errors import DeployError
from deploy.run import find

MB = 1 << 20
TABLE = """
label: dos
label-id: 0x12345678
start=8192, size=8192, type=c, bootable
start=16384, size=16384, type=83
start=32768, size=16384, type=83
"""

needs_sfdisk = pytest.mark.skipif(find("sfdisk") is None, reason="sfdisk is not installed")


def card(path: Path, table: str = TABLE, size: int = 32 * MB) -> Path:
    with path.open("wb") as file:
        file.truncate(size)
    tool = find("sfdisk")
    assert tool
    subprocess.run([tool, "-q", path], input=table, text=True, check=True)
    return path


def listed(path: Path) -> dict[str, Any]:
    tool = find("sfdisk")
    assert tool
    output = subprocess.run([tool, "-J", path], capture_output=True, check=True).stdout
    table: dict[str, Any] = json.loads(output)["partitiontable"]
    return table


def entry(kind: int, start: int, size: int) -> bytes:
    return struct.pack("<B3sB3sII", 0, b"\0" * 3, kind, b"\0" * 3, start, size)


def sector(*entries: bytes) -> bytes:
    return b"\0" * 446 + b"".join(entries).ljust(64, b"\0") + b"\x55\xaa"


@needs_sfdisk
@pytest.mark.parametrize("extra", [0, 1, 511, 4 * MB - 512, 3 * MB + 12345])
def test_the_last_partition_ends_at_the_last_4_mib_of_the_card(tmp_path: Path, extra: int) -> None:
    path = card(tmp_path / "card.img", size=32 * MB)
    with path.open("r+b") as file:
        file.truncate(32 * MB + extra)
    before = listed(path)
    assert grow.grow(path, 3)
    after = listed(path)
    assert after["id"] == before["id"]
    assert after["partitions"][:2] == before["partitions"][:2]
    last, was = after["partitions"][2], before["partitions"][2]
    assert (last["start"], last["type"]) == (was["start"], was["type"])
    assert (last["start"] + last["size"]) * 512 == 32 * MB


@needs_sfdisk
def test_only_the_first_sector_changes_and_only_once(tmp_path: Path) -> None:
    path = card(tmp_path / "card.img", size=36 * MB)
    before = path.read_bytes()
    assert grow.grow(path, 3)
    after = path.read_bytes()
    assert after[512:] == before[512:] and after[:512] != before[:512]
    assert after[:440] == before[:440]
    shutil.copy(path, tmp_path / "again.img")
    assert not grow.grow(tmp_path / "again.img", 3)
    assert (tmp_path / "again.img").read_bytes() == after


def test_a_card_of_2_tib_and_more_is_used_as_far_as_the_table_can_say() -> None:
    table = sector(entry(0xC, 8192, 8192), entry(0x83, 16384, 8192))
    after = grow.grown(table, 2, 8 * 1024**4 // 512)
    assert after is not None
    last = grow.partitions(after)[1]
    assert last.end % grow.ALIGN_SECTORS == 0 and 0 <= 2**32 - last.end <= grow.ALIGN_SECTORS


STRANGE = {
    "no partition table": b"\0" * 512,
    "no partition table (MBR) in": sector()[:100],
    "is a GPT": sector(entry(0xEE, 1, 100000)),
    "there is no partition 3": sector(entry(0xC, 64, 64), entry(0x83, 128, 64)),
    "is of type 0x0c": sector(entry(0x83, 64, 64), entry(0x83, 128, 64), entry(0xC, 256, 64)),
    "is an extended one": sector(entry(0xC, 64, 64), entry(0x5, 128, 999), entry(0x83, 256, 64)),
    "partition 4 lies behind": sector(
        entry(0xC, 64, 64), entry(0x83, 128, 64), entry(0x83, 256, 64), entry(0x83, 512, 64)
    ),
    "partition 2 lies behind or over": sector(
        entry(0xC, 64, 64), entry(0x83, 128, 200), entry(0x83, 256, 64)
    ),
    "the card at 4096": sector(entry(0xC, 64, 64), entry(0x83, 128, 64), entry(0x83, 256, 4000)),
    "has start 0": sector(entry(0xC, 0, 64), entry(0x83, 128, 64), entry(0x83, 256, 64)),
}


@pytest.mark.parametrize("told", STRANGE)
def test_a_strange_table_is_refused_and_left_alone(tmp_path: Path, told: str) -> None:
    path = tmp_path / "card.img"
    path.write_bytes(STRANGE[told].ljust(4096 * 512, b"\0"))
    before = path.read_bytes()
    with pytest.raises(DeployError) as error:
        grow.grow(path, 3)
    assert told in str(error.value) and "\n" not in str(error.value)
    assert path.read_bytes() == before


def kernel(root: Path, name: str, number: int, label: bytes, sectors: str = "512") -> Path:
    """A partition as sysfs and /dev have it, with the beginning of an ext4."""
    disk, folder = name.rpartition("p")[0], root / "sys/class/block" / name
    place = root / "sys/devices" / disk / name
    place.mkdir(parents=True)
    (place / "partition").write_text(f"{number}\n")
    (place.parent / "queue").mkdir(exist_ok=True)
    (place.parent / "queue/logical_block_size").write_text(f"{sectors}\n")
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.symlink_to(place)
    (root / "dev").mkdir(exist_ok=True)
    device = root / "dev" / name
    block = bytearray(2048)
    block[1024 + 0x38 : 1024 + 0x3A] = b"\x53\xef"
    block[1024 + 0x78 : 1024 + 0x78 + len(label)] = label
    device.write_bytes(block)
    return device


def test_the_partition_is_found_by_its_label_without_udev(tmp_path: Path) -> None:
    kernel(tmp_path, "mmcblk0p2", 2, b"blimp-root")
    kernel(tmp_path, "mmcblk0p3", 3, b"blimp-data")
    assert grow.find(root=tmp_path) == (tmp_path / "dev/mmcblk0", 3)
    kernel(tmp_path, "mmcblk1p3", 3, b"blimp-data")
    with pytest.raises(DeployError, match="2 partitions are called blimp-data; expected one"):
        grow.find(root=tmp_path)


@pytest.mark.skipif(find("mke2fs") is None, reason="mke2fs is not installed")
def test_the_label_is_where_mke2fs_puts_it(tmp_path: Path) -> None:
    device = kernel(tmp_path, "mmcblk0p3", 3, b"")
    with device.open("r+b") as file:
        file.truncate(4 * MB)
    tool = find("mke2fs")
    assert tool
    subprocess.run([tool, "-q", "-F", "-t", "ext4", "-L", "blimp-data", device], check=True)
    assert grow.find(root=tmp_path)[1] == 3


def test_what_cannot_be_grown_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert grow.main(tmp_path) == 2
    told = "grow: 0 partitions are called blimp-data; expected one\n"
    assert capsys.readouterr().err == told
    kernel(tmp_path, "mmcblk0p3", 3, b"blimp-data", "4096")
    assert grow.main(tmp_path) == 2
    assert capsys.readouterr().err == "grow: mmcblk0p3: sectors of 4096 bytes; expected 512\n"
