"""What is never written: the system's disk, mounted, fixed, held, protected, a partition."""

from __future__ import annotations

import dataclasses
import json
import os
import stat
import subprocess
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from card_bench import Bench, refused, tool

from deploy.errors import DeployError
from deploy.flash import disks
from deploy.flash.disks import Entry
from deploy.flash.write import Target


def entry(name: str, kind: str = "disk", *upon: Entry, **facts: Any) -> Entry:
    """A device as lsblk shows it: a card of 31.9 GB in a reader, where nothing else is said."""
    usual = {"size": 31_900_000_000, "rm": kind == "disk", "ro": False, "vendor": "Generic ",
             "model": "STORAGE DEVICE", "serial": None, "fstype": None, "label": None,
             "mountpoints": [None]}  # fmt: skip
    found = {"name": name, "kname": name, "type": kind, **usual, **facts}
    return found | {"children": list(upon)} if upon else found


def part(name: str, point: str | None = None, *upon: Entry, **facts: Any) -> Entry:
    return entry(name, "part", *upon, mountpoints=[point], **facts)


LUKS = entry("luks", "crypt", entry("vg-root", "lvm", mountpoints=["/"]), entry("vg-home", "lvm"))
REFUSED = [
    (entry("nvme0n1", "disk", part("nvme0n1p1", "/boot/efi"), part("nvme0n1p3", None, LUKS)),
     "this machine runs on it (nvme0n1p1 is mounted on /boot/efi)"),
    (entry("nvme0n1", "disk", part("nvme0n1p3", None, LUKS)),
     "this machine runs on it (vg-root is mounted on /)"),
    (entry("sdb", "disk", part("sdb1", "/srv"), part("sdb2", "/")),
     "this machine runs on it (sdb2 is mounted on /)"),
    (entry("sdc", size=10**12, rm=False, vendor=None, model="Portable SSD"),
     "Portable SSD, 1.0 TB, is a fixed disk"),
    (entry("sdd", "disk", part("sdd1", "/media/pilot/MY PHOTOS")),
     "in use: sdd1 is mounted on /media/pilot/MY PHOTOS"),
    (entry("sde", "disk", part("sde1", None, entry("backup", "crypt"))),
     "in use: sde1 is held by backup"),
    (entry("sdf", size=0), "no card in it"),
    (entry("sdg", ro=True), "write-protected"),
    (entry("sdh", mountpoints=["/srv"]), "in use: sdh is mounted on /srv"),
    (entry("sdi", "disk", part("sdi1", "[SWAP]")),
     "this machine runs on it (sdi1 is swap space)"),
    (entry("sr0", "rom", rm=True, vendor="DVD", model="RW"), "DVD RW: not a disk"),
    (entry("loop0", "loop"), "is a fixed disk"),
    (entry("dm-3", "crypt"), "is a fixed disk"),
]  # fmt: skip


@pytest.mark.parametrize(("disk", "said"), REFUSED, ids=lambda value: str(value)[:9])
def test_it_refuses(disk: Entry, said: str) -> None:
    with pytest.raises(DeployError) as caught:
        disks.check(disk)
    assert str(caught.value).startswith(f"/dev/{disk['name']}: ") and said in str(caught.value)


def test_it_takes_a_card_in_a_reader_or_a_built_in_slot(tmp_path: Path) -> None:
    disks.check(entry("sdb", "disk", part("sdb1"), part("sdb2")))
    slot = entry("mmcblk0", rm=False, vendor=None, model=None, serial="0x12ab34cd")
    (tmp_path / "device").mkdir()
    (tmp_path / "device/name").write_text("SC32G\n")
    for kind in ("MMC", "SD"):  # eMMC is soldered to the board
        (tmp_path / "device/type").write_text(f"{kind}\n")
        found = disks.completed(slot, tmp_path)
        with pytest.raises(DeployError) if kind == "MMC" else nullcontext():
            disks.check(found)
    shown = disks.describe(Path("/dev/mmcblk0"), found, 1)
    assert shown == "/dev/mmcblk0: SC32G, 31.9 GB, serial 0x12ab34cd\n  no partitions"


def test_it_shows_what_a_person_knows_a_card_by() -> None:
    boot = part("sdb1", size=270_000_000, fstype="vfat", label="BLIMPBOOT")
    root = part("sdb2", size=2_100_000_000, fstype="ext4", label="evil\x1b[2J")
    disk = entry("sdb", "disk", boot, root, serial="000000001206")
    assert disks.describe(Path("/dev/sdb"), disk, disk["size"]).splitlines() == [
        "/dev/sdb: Generic STORAGE DEVICE, 31.9 GB, serial 000000001206",
        "  sdb1: 270 MB vfat BLIMPBOOT",
        "  sdb2: 2.1 GB ext4 evil?[2J",
    ]


def test_a_partition_is_named_with_its_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = tmp_path / "node"
    try:  # lsblk's answer is laid out: there is no such device here
        os.mknod(node, stat.S_IFBLK | 0o600, os.makedev(8, 208))
    except PermissionError:
        pytest.skip("only root makes device nodes")
    with pytest.raises(DeployError, match="lsblk: "):
        disks.find(node)
    said = json.dumps({"blockdevices": [part("sdb1", pkname="sdb")]}).encode()
    monkeypatch.setattr(disks, "run", lambda words: said)
    with pytest.raises(DeployError, match="a partition; name the whole disk, /dev/sdb"):
        disks.find(node)


def test_the_disk_that_this_machine_runs_on_is_refused() -> None:
    """The real one, by its facts alone: it is not opened."""
    said = subprocess.run(["findmnt", "-no", "SOURCE", "/"], capture_output=True, text=True)
    source = Path(said.stdout.strip() or "/none")
    if not source.is_block_device():
        pytest.skip("this system's root is on no block device of its own (a container)")
    with pytest.raises(DeployError, match=r"this machine runs on it|a partition; name"):
        disks.find(source)


def test_the_program_says_what_is_no_card(bench: Bench) -> None:
    def device(path: Path) -> list[str]:
        return dataclasses.replace(bench, card=path).command()

    refused(device(Path("/dev/null")), "neither a disk nor an image file", program=True)
    refused(device(bench.folder), "neither a disk nor an image file")
    refused(device(bench.folder / "none"), "truncate -s 8G")
    refused(device(Path("/dev/no-such-card")), "No such file or directory")
    refused(device(bench.image), "the image itself")


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A loop device with an ext4 on it; skips where none can be had."""
    file = tmp_path / "disk"
    with open(file, "wb") as opened:
        opened.truncate(48 << 20)
    tool("mke2fs", "-q", "-t", "ext4", str(file))
    done = subprocess.run(
        ["losetup", "--find", "--show", str(file)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.skip(f"no loop device here: {done.stderr.strip()}")
    device = done.stdout.strip()
    try:
        yield device, file
    finally:
        subprocess.run(["losetup", "--detach", device], check=False)


def test_a_real_device_that_is_mounted_or_fixed_is_refused(
    bench: Bench, loop: tuple[str, Path]
) -> None:
    device, file = loop
    before = file.read_bytes()
    at_loop = dataclasses.replace(bench, card=Path(device))
    words, name = at_loop.command(), Path(device).name
    refused(words, "is a fixed disk (not removable)")
    refused(at_loop.customise(), "is a fixed disk")
    refused(dataclasses.replace(bench, card=file).command(), f"in use as /dev/{name}")
    point = bench.folder / "mounted here"
    point.mkdir()
    mounted = subprocess.run(["mount", "-o", "ro", device, point], check=False)
    if mounted.returncode:
        pytest.skip("mounting is not allowed here")
    try:
        refused(words, f"in use: {name} is mounted on {point}", program=True)
        # The last line of defence: the kernel itself.
        with pytest.raises(DeployError, match="in use by the system or another program"):
            Target.open(Path(device))
    finally:
        subprocess.run(["umount", point], check=True)
    assert file.read_bytes() == before
