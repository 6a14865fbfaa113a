"""A base image in the layout of Raspberry Pi OS, made here in small."""

from __future__ import annotations

import shutil
import uuid
from pathlib import Path

from card_parts import EPOCH, root_members, write_tar

from deploy.image import ext4, fat, partitions
from deploy.image.packages.board import load_board
from deploy.image.partitions import FAT32_LBA, LINUX, Partition
from deploy.image.tree import Tree

KERNEL = "6.12.1+rpt-rpi-v6"
UUID = uuid.UUID("12345678-1234-1234-1234-123456789abc")
BOARD = load_board("zerow")


def make_base(
    path: Path,
    *,
    architecture: str = "armhf",
    kernel: str = KERNEL,
    codename: str = "trixie",
    identifier: str = "raspbian",
    without: str = "",
    parts: int = 2,
) -> Path:
    """An image as Raspberry Pi's, of a few small files."""
    tree = make_tree(path.with_name("work"), architecture, kernel, codename, identifier)
    status = tree.read("var/lib/dpkg/status").decode()
    for name in BOARD.package_names:
        if name != without:
            status += f"\nPackage: {name}\nStatus: install ok installed\n"
            status += f"Architecture: {architecture}\nVersion: 1\n"
    tree.write("var/lib/dpkg/status", status)
    return write_base(path, tree, 48 << 20, parts)


def make_tree(
    work: Path,
    architecture: str,
    kernel: str = KERNEL,
    codename: str = "trixie",
    identifier: str = "raspbian",
) -> Tree:
    """The root of such an image; its contents lie in the folder `work`."""
    members = root_members(architecture, kernel)
    says = f'ID={identifier}\nVERSION_CODENAME="{codename}"\n'
    members["usr/lib/os-release"] = says.encode()
    members["usr/lib/systemd/system/NetworkManager.service"] = (
        b"[Service]\nExecStart=/usr/bin/ip\n[Install]\nWantedBy=multi-user.target\n"
    )
    members["etc/systemd/system/multi-user.target.wants/NetworkManager.service"] = (
        "/usr/lib/systemd/system/NetworkManager.service"
    )
    members["etc/hostname"] = b"raspberrypi\n"
    members["usr/share/of-the-base"] = b"stays"
    work.mkdir()
    return Tree.from_tar(write_tar(work / "tar", members))


def write_base(path: Path, tree: Tree, size: int, parts: int = 2) -> Path:
    """The image: a FAT with kernels and firmware, and the tree in a root that can be written."""
    work = path.with_name(path.name + ".work")
    work.mkdir()
    ext4.make(work / "root", size, tree, "rootfs", UUID, EPOCH - 1000, journal=True)
    boot = Tree()
    room = fat.bytes_needed(boot)
    for name in ("kernel.img", "kernel7.img", "bootcode.bin", "start.elf", "fixup.dat",
                 "bcm2708-rpi-zero-w.dtb", "overlays/disable-bt.dtbo", "initramfs",
                 "issue.txt"):  # fmt: skip
        boot.write(name, name)
    boot.write("config.txt", "[all]\ndtparam=audio=on\n")
    boot.write("cmdline.txt", "console=serial0,115200 init=/usr/lib/raspberrypi-sys-mods/firstboot")
    fat.make(work / "boot", room, boot, "BOOTFS", 1, EPOCH)
    layout = [
        Partition("boot", FAT32_LBA, work / "boot", fat.used_ranges(work / "boot")),
        Partition("root", LINUX, work / "root", ext4.used_ranges(work / "root")),
    ]
    partitions.assemble(path, layout[:parts], 1)
    shutil.rmtree(work)
    return path
