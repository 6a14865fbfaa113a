"""Trees of sysfs, /proc and udev's database as real machines show them, one disk a line."""

from __future__ import annotations

from pathlib import Path


class Tree:
    """Grows the files of one machine under a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._mounts = 20
        self.file("proc/swaps", "Filename\tType\tSize\tUsed\tPriority\n")
        self.file("proc/self/mountinfo", "")

    def file(self, path: str, text: str) -> None:
        """A file with this text."""
        place = self.root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)

    def disk(self, name: str, number: str, gb: float, bus: str = "usb1/1-1", /, *,
             removable: int = 0, ro: int = 0, udev: str = "", **device: str) -> None:  # fmt: skip
        """A whole disk; `device` are the attributes of what it sits on."""
        folder = f"sys/devices/{bus}/block/{name}"
        self._block(folder, name, number, int(gb * 1e9) // 512, ro)
        self.file(f"{folder}/removable", f"{removable}\n")
        for key, value in device.items():
            self.file(f"{folder}/device/{key}", f"{value}\n")
        self.file(f"run/udev/data/b{number}", udev)

    def part(self, name: str, index: int, number: str, gb: float, udev: str = "") -> str:
        """A partition of a disk; gives its name."""
        disk = (self.root / "sys/class/block" / name).resolve()
        part = f"{name}{'p' if name[-1].isdigit() else ''}{index}"
        folder = str((disk / part).relative_to(self.root.resolve()))
        self._block(folder, part, number, int(gb * 1e9) // 512, 0)
        self.file(f"{folder}/partition", f"{index}\n")
        self.file(f"run/udev/data/b{number}", udev)
        return part

    def mapped(self, name: str, number: str, called: str, *below: str) -> None:
        """A device-mapper device upon others."""
        folder = f"sys/devices/virtual/block/{name}"
        self._block(folder, name, number, 1000, 0)
        self.file(f"{folder}/removable", "0\n")
        self.file(f"{folder}/dm/name", f"{called}\n")
        for lower in below:
            held = (self.root / "sys/class/block" / lower).resolve() / "holders"
            held.mkdir(parents=True, exist_ok=True)
            (held / name).symlink_to(self.root.resolve() / folder)
            (self.root / folder / "slaves").mkdir(exist_ok=True)
            target = (self.root / "sys/class/block" / lower).resolve()
            (self.root / folder / "slaves" / lower).symlink_to(target)

    def loop(self, name: str, number: str, file: str) -> None:
        """A file shown as a disk."""
        folder = f"sys/devices/virtual/block/{name}"
        self._block(folder, name, number, 1000, 0)
        self.file(f"{folder}/removable", "0\n")
        self.file(f"{folder}/loop/backing_file", f"{file}\n")

    def mount(self, number: str, source: str, point: str, kind: str = "ext4") -> None:
        """A line of mountinfo."""
        self._mounts += 1
        place = self.root / "proc/self/mountinfo"
        line = f"{self._mounts} 1 {number} / {point} rw,noatime shared:1 - {kind} {source} rw\n"
        place.write_text(place.read_text() + line)

    def swap(self, source: str) -> None:
        """A line of /proc/swaps."""
        place = self.root / "proc/swaps"
        place.write_text(f"{place.read_text()}{source}\tpartition\t100\t0\t-2\n")

    def _block(self, folder: str, name: str, number: str, sectors: int, ro: int) -> None:
        self.file(f"{folder}/dev", f"{number}\n")
        self.file(f"{folder}/size", f"{sectors}\n")
        self.file(f"{folder}/ro", f"{ro}\n")
        link = self.root / "sys/class/block" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(self.root.resolve() / folder)


def laptop(root: Path) -> Tree:
    """An encrypted system on NVMe, and in its slots everything a person could name by mistake."""
    tree = Tree(root)
    tree.disk("nvme0n1", "259:0", 512, "pci0000:00/nvme/nvme0", model="FAST SSD 512GB")
    tree.part("nvme0n1", 1, "259:1", 0.5)
    tree.part("nvme0n1", 2, "259:2", 1)
    tree.part("nvme0n1", 3, "259:3", 510)
    tree.mapped("dm-0", "253:0", "luks-root", "nvme0n1p3")
    tree.mapped("dm-1", "253:1", "vg-root", "dm-0")
    tree.mapped("dm-2", "253:2", "vg-swap", "dm-0")
    tree.mount("253:1", "/dev/mapper/vg-root", "/")
    tree.mount("259:2", "/dev/nvme0n1p2", "/boot")
    tree.mount("0:25", "tmpfs", "/tmp", "tmpfs")
    tree.swap("/dev/dm-2")

    usb = {"vendor": "Generic ", "model": "STORAGE DEVICE  ", "type": "0"}
    serial = "E:ID_SERIAL_SHORT=000000001206\nE:ID_FS_LABEL=x\n"
    tree.disk("sdb", "8:16", 31.9, removable=1, udev=serial, **usb)  # the card
    tree.part("sdb", 1, "8:17", 0.27, "E:ID_FS_TYPE=vfat\nE:ID_FS_LABEL=BLIMPBOOT\n")
    tree.part("sdb", 2, "8:18", 2.1, "E:ID_FS_TYPE=ext4\nE:ID_FS_LABEL=blimp-root\n")
    tree.disk("sdc", "8:32", 1000, model="Portable SSD", type="0")
    tree.disk("sdd", "8:48", 31.9, removable=1, **usb)
    tree.part("sdd", 1, "8:49", 31)
    tree.mount("8:49", "/dev/sdd1", "/media/pilot/MY\\040PHOTOS", "vfat")
    tree.disk("sde", "8:64", 64, removable=1, **usb)
    tree.part("sde", 1, "8:65", 63)
    tree.mapped("dm-3", "253:3", "backup", "sde1")  # unlocked, not mounted
    tree.disk("sdf", "8:80", 0, removable=1, **usb)
    tree.disk("sdg", "8:96", 8, removable=1, ro=1, **usb)
    tree.disk("sdh", "8:112", 16, removable=1, **usb)
    tree.part("sdh", 1, "8:113", 15)
    tree.mount("0:51", "/dev/sdh1", "/srv", "btrfs")  # under a number of its own
    tree.disk("sdi", "8:128", 16, removable=1, **usb)
    tree.part("sdi", 1, "8:129", 15)
    tree.swap("/dev/sdi1")
    tree.disk("sr0", "11:0", 4.7, removable=1, vendor="DVD", model="RW", type="5")
    tree.disk("mmcblk0", "179:0", 31.9, "pci0000:00/mmc0:1234", type="SD", name="SC32G",
              serial="0x12ab34cd")  # fmt: skip
    tree.disk("mmcblk1", "179:8", 62.5, "pci0000:00/mmc1:0001", type="MMC", name="DF4064")
    tree.loop("loop0", "7:0", "/home/pilot/card.img")
    return tree


def live_stick(root: Path) -> Tree:
    """A system that runs from a file on a USB stick."""
    tree = Tree(root)
    tree.disk("sda", "8:0", 16, removable=1, vendor="Stick", model="X", type="0")
    tree.part("sda", 1, "8:1", 15)
    tree.mount("8:1", "/dev/sda1", "/run/medium", "iso9660")
    tree.loop("loop0", "7:0", "/run/medium/live/root.squashfs")
    tree.mount("7:0", "/dev/loop0", "/", "squashfs")
    return tree


def pi(root: Path) -> Tree:
    """A Raspberry Pi that runs from its own card, with another one in a reader."""
    tree = Tree(root)
    tree.disk("mmcblk0", "179:0", 31.9, "platform/mmc0:aaaa", type="SD", name="SC32G")
    tree.part("mmcblk0", 1, "179:1", 0.5)
    tree.part("mmcblk0", 2, "179:2", 31)
    tree.mount("179:2", "/dev/mmcblk0p2", "/")
    tree.mount("179:1", "/dev/mmcblk0p1", "/boot/firmware", "vfat")
    tree.disk("sda", "8:0", 31.9, removable=1, vendor="Generic", model="Reader", type="0")
    return tree
