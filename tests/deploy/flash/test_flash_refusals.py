"""What is never written: the system's disk, mounted, fixed, held, protected, a partition."""

from __future__ import annotations

import os
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import machines
import pytest
from card_bench import Bench, refused, tool

from deploy.errors import DeployError
from deploy.flash import disks
from deploy.flash.disks import Machine
from deploy.flash.write import Target

REFUSED = [
    (machines.laptop, "nvme0n1", "this machine runs on it (dm-1 is mounted on /)"),
    (machines.laptop, "sdc", "Portable SSD, 1.0 TB, is a fixed disk"),
    (machines.laptop, "sdd", "in use: sdd1 is mounted on /media/pilot/MY PHOTOS"),
    (machines.laptop, "sde", "in use: sde1 is held by dm-3 (backup)"),
    (machines.laptop, "sdf", "no card in it"),
    (machines.laptop, "sdg", "write-protected"),
    (machines.laptop, "sdh", "in use: sdh1 is mounted on /srv"),
    (machines.laptop, "sdi", "this machine runs on it (/dev/sdi1 is swap space)"),
    (machines.laptop, "sr0", "not a disk"),
    (machines.laptop, "mmcblk1", "is a fixed disk"),
    (machines.laptop, "loop0", "is a fixed disk"),
    (machines.laptop, "dm-3", "is a fixed disk"),
    (machines.live_stick, "sda", "this machine runs on it (loop0 is mounted on /)"),
    (machines.pi, "mmcblk0", "this machine runs on it (mmcblk0p2 is mounted on /)"),
]


@pytest.mark.parametrize(("make", "name", "said"), REFUSED, ids=lambda value: str(value)[:9])
def test_it_refuses(tmp_path: Path, make: Callable[[Path], object], name: str, said: str) -> None:
    make(tmp_path)
    machine = Machine(tmp_path)
    with pytest.raises(DeployError) as caught:
        disks.check(machine, machine.disk(name))
    assert str(caught.value).startswith(f"/dev/{name}: ") and said in str(caught.value)


@pytest.mark.parametrize(
    ("make", "name"),
    [(machines.laptop, "sdb"), (machines.laptop, "mmcblk0"), (machines.pi, "sda")],
)
def test_it_takes_a_card_in_a_reader(
    tmp_path: Path, make: Callable[[Path], object], name: str
) -> None:
    make(tmp_path)
    machine = Machine(tmp_path)
    disks.check(machine, machine.disk(name))


def test_it_shows_what_a_person_knows_a_card_by(tmp_path: Path) -> None:
    machines.laptop(tmp_path)
    machine = Machine(tmp_path)
    disk = machine.disk("sdb")
    assert disks.describe(Path("/dev/sdb"), disk, disk.size_bytes).splitlines() == [
        "/dev/sdb: Generic STORAGE DEVICE, 31.9 GB, serial 000000001206",
        "  sdb1: 270 MB vfat BLIMPBOOT",
        "  sdb2: 2.1 GB ext4 blimp-root",
    ]
    shown = disks.describe(Path("/dev/mmcblk0"), machine.disk("mmcblk0"), 1)
    assert shown == "/dev/mmcblk0: SC32G, 31.9 GB, serial 0x12ab34cd\n  no partitions"


def test_a_disk_cannot_write_on_the_terminal(tmp_path: Path) -> None:
    tree = machines.Tree(tmp_path)
    tree.disk("sdb", "8:16", 1, removable=1, model="evil\x1b[2J", type="0")
    assert "\x1b" not in disks.describe(Path("/dev/sdb"), Machine(tmp_path).disk("sdb"), 1)


def test_a_partition_is_named_with_its_disk(tmp_path: Path) -> None:
    machines.laptop(tmp_path / "tree")
    machine = Machine(tmp_path / "tree")
    assert machine.whole("sdb1") == "sdb" and machine.whole("mmcblk0") == "mmcblk0"
    node = tmp_path / "node"
    try:  # only its number is looked at; there is no such device here
        os.mknod(node, stat.S_IFBLK | 0o600, os.makedev(8, 17))
    except PermissionError:
        pytest.skip("only root makes device nodes")
    with pytest.raises(DeployError, match="a partition; name the whole disk, /dev/sdb"):
        disks.find(machine, node)
    other = tmp_path / "other"
    os.mknod(other, stat.S_IFBLK | 0o600, os.makedev(8, 208))
    with pytest.raises(DeployError, match="knows no such disk"):
        disks.find(machine, other)


def test_a_file_that_a_loop_shows_is_in_use(tmp_path: Path) -> None:
    card = tmp_path / "card.img"
    card.touch()
    tree = machines.Tree(tmp_path / "tree")
    tree.loop("loop3", "7:3", str(card.resolve()))
    with pytest.raises(DeployError, match="in use as loop3"):
        disks.find(Machine(tmp_path / "tree"), card)


def test_the_disk_that_this_machine_runs_on_is_refused() -> None:
    """The real one, by its facts alone: it is not opened."""
    number = Path("/").stat().st_dev
    machine = Machine()
    name = machine.name_of(os.major(number), os.minor(number))
    if name is None:
        pytest.skip("this system's root is on no block device of its own (a container)")
    with pytest.raises(DeployError, match="this machine runs on it"):
        disks.check(machine, machine.disk(machine.whole(name)))


def test_the_program_says_what_is_no_card(bench: Bench) -> None:
    def device(path: str) -> list[str]:
        return [path if word == str(bench.card) else word for word in bench.command()]

    refused(device("/dev/null"), "neither a disk nor an image file", program=True)
    refused(device(str(bench.folder)), "neither a disk nor an image file")
    refused(device(str(bench.folder / "none")), "truncate -s 8G")
    refused(device("/dev/no-such-card"), "No such file or directory")
    refused(device(str(bench.image)), "the image itself")


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
    words = [device if word == str(bench.card) else word for word in bench.command()]
    refused(words, "is a fixed disk (not removable)")
    refused([*bench.customise()[:-1], "--device", device], "is a fixed disk")
    point = bench.folder / "mounted here"
    point.mkdir()
    mounted = subprocess.run(["mount", "-o", "ro", device, point], check=False)
    if mounted.returncode:
        pytest.skip("mounting is not allowed here")
    try:
        refused(words, f"in use: {Path(device).name} is mounted on {point}", program=True)
        # The last line of defence: the kernel itself.
        with pytest.raises(DeployError, match="in use by the system or another program"):
            Target.open(Path(device))
    finally:
        subprocess.run(["umount", point], check=True)
    assert file.read_bytes() == before
