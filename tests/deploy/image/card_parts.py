"""A card's ingredients in small, made here: a packages' root, a kernel, a checkout."""

from __future__ import annotations

import io
import json
import lzma
import os
import shutil
import subprocess
import tarfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from deploy.image import card
from deploy.image.packages.board import load_board
from deploy.image.packages.kernel import Kernel
from deploy.run import find, run

CHECKOUT = Path(__file__).parents[3]
EPOCH = 1_760_000_000
RELEASE = "6.12.1-test"
PASSWD = """\
root:x:0:0:root:/root:/bin/bash
daemon:x:1:1:daemon:/usr/sbin:/usr/sbin/nologin
somebody:x:1001:1001::/home/somebody:/bin/bash
systemd-network:x:998:998::/:/usr/sbin/nologin
"""
GROUP = """\
root:x:0:
daemon:x:1:
dialout:x:20:
shadow:x:42:
video:x:44:
somebody:x:1001:
render:x:993:
systemd-journal:x:999:
systemd-network:x:998:
"""
# A password, an empty one, a locked one; and systemd-network has no line at all.
SHADOW = """\
root:$6$x$y:19000:0:99999:7:::
daemon::19000:0:99999:7:::
somebody:!$6$x:19000::::::
"""
UNIT = "[Unit]\nDescription=x\n[Service]\nExecStart=/usr/bin/python3\n[Install]\n"
NETWORKD = f"""\
{UNIT}WantedBy=multi-user.target
Also=systemd-networkd.socket
Alias=dbus-net.service
"""
SOCKET = """\
[Unit]
Description=x
[Socket]
ListenNetlink=route 1361
[Install]
WantedBy=sockets.target
"""
STATUS = """\
Package: base-files
Status: install ok installed
Architecture: {architecture}
Version: 13.8
Description: of several lines
 Status: no field

Package: gone
Status: deinstall ok config-files
Architecture: all
Version: 1
"""
CAPABILITY = bytes.fromhex("0100000200040000000000000000000000000000")


def root_members(architecture: str = "arm64", kernel: str = "") -> dict[str, bytes | str | None]:
    """Paths of a small Debian: bytes of a file, a text for a link, None for a folder."""
    status = STATUS.format(architecture=architecture).encode()
    programs = ("bin/python3", "bin/systemd-tmpfiles", "bin/iw", "bin/ip", "bin/rm", "bin/kill",
                "sbin/sshd", "sbin/wpa_supplicant")  # fmt: skip
    members: dict[str, bytes | str | None] = {
        "bin": "usr/bin",
        "lib": "usr/lib",
        "sbin": "usr/sbin",
        "usr/bin": None,
        "usr/sbin": None,
        "tmp": None,
        "root": None,
        "usr/bin/busybox": b"\x7fELF busybox",
        "usr/lib/systemd/systemd": b"\x7fELF systemd",
        "usr/lib/os-release": b'NAME="Debian"\nVERSION_CODENAME=trixie\n',
        "usr/share/über uns/a b.txt": "übrig".encode(),
        "etc/passwd": PASSWD.encode(),
        "etc/group": GROUP.encode(),
        "etc/shadow": SHADOW.encode(),
        "etc/gshadow": b"root:*::\n",
        "etc/passwd-": PASSWD.encode(),
        "etc/ssh/ssh_host_ed25519_key": b"one key for all cards",
        "var/lib/dpkg/status": status,
        "var/log/dpkg.log": b"of one day",
        "var/cache/apt/pkgcache.bin": b"of one machine",
        "usr/lib/systemd/system/systemd-networkd.service": NETWORKD.encode(),
        "usr/lib/systemd/system/systemd-networkd.socket": SOCKET.encode(),
        "usr/lib/systemd/system/multi-user.target": b"[Unit]\nDescription=x\n",
        "usr/lib/systemd/system/other.service": f"{UNIT}WantedBy=multi-user.target\n".encode(),
        "usr/lib/systemd/system-preset/90-systemd.preset": b"enable other.service\n",
        "etc/systemd/system/multi-user.target.wants/other.service": (
            "/usr/lib/systemd/system/other.service"
        ),
    }
    for name in programs:
        members[f"usr/{name}"] = b"#!/bin/sh\n"
    if kernel:
        for name, data in modules(kernel).items():
            members[f"usr/lib/modules/{kernel}/{name}"] = data
    return members


def modules(release: str) -> dict[str, bytes]:
    """A kernel's modules with depmod's tables."""
    dependencies = (
        "kernel/ext4.ko.xz: kernel/jbd2.ko kernel/crc16.ko\n"
        "kernel/jbd2.ko:\nkernel/crc16.ko:\nkernel/crc32c_generic.ko:\nkernel/snd.ko:\n"
    )
    plain = ("jbd2", "crc16", "crc32c_generic", "snd")
    return {
        "modules.dep": dependencies.encode(),
        "modules.builtin": b"kernel/overlay.ko\n",
        "modules.softdep": b"softdep ext4 pre: crc32c_generic\n",
        "kernel/ext4.ko.xz": lzma.compress(f"ext4 of {release}".encode()),
        **{f"kernel/{name}.ko": name.encode() for name in plain},
    }


def write_tar(path: Path, members: dict[str, bytes | str | None], reverse: bool = False) -> Path:
    """A tar as mmdebstrap makes it, with modes, owners and a capability to be kept."""
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in sorted(members.items(), reverse=reverse):
            info = tarfile.TarInfo(f"./{name}")
            info.mtime = 1_700_000_000 if "os-release" in name else 1_900_000_000
            info.mode = 0o1777 if name == "tmp" else 0o700 if name == "root" else 0o755
            if content is None:
                info.type = tarfile.DIRTYPE
                tar.addfile(info)
            elif isinstance(content, str):
                info.type, info.linkname = tarfile.SYMTYPE, content
                tar.addfile(info)
            else:
                info.size = len(content)
                info.mode = 0o4755 if name.endswith("/ip") else 0o644
                if name.startswith(("usr/bin/", "usr/sbin/")) and not name.endswith("/ip"):
                    info.mode = 0o755
                if name.endswith("a b.txt"):
                    info.uid, info.gid = 1, 44
                if name.endswith("/iw"):
                    raw = CAPABILITY.decode("utf-8", "surrogateescape")
                    info.pax_headers = {"SCHILY.xattr.security.capability": raw}
                tar.addfile(info, io.BytesIO(content))
        null = tarfile.TarInfo("./dev/null")
        null.type, null.devmajor, null.devminor = tarfile.CHRTYPE, 1, 3
        tar.addfile(null)
    return path


@dataclass(frozen=True)
class Ingredients:
    """What others made, as files."""

    kernel: Kernel
    rootfs: Path
    site: Path


def build(image: Path, given: Ingredients, checkout: Path, epoch: int) -> None:
    """A card for the emulator."""
    board = load_board("qemu")
    card.build(image, board, given.kernel, given.rootfs, given.site, checkout, epoch)


def make_ingredients(folder: Path, reverse: bool = False) -> Ingredients:
    """Everything that `build` takes, written into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write_tar(folder / "root.tar", root_members(), reverse)
    tables = folder / f"modules/usr/lib/modules/{RELEASE}"
    boot, site = folder / "boot", folder / "site"
    contents = [(tables / name, data) for name, data in modules(RELEASE).items()]
    contents += [
        (boot / "vmlinuz", b"kernel " * 1000),
        (boot / "bcm2837-rpi-3-b.dtb", b"tree"),
        (boot / "overlays/disable-bt.dtbo", b"overlay"),
        (site / "mcap/__init__.py", b"x = 1\n"),
        (site / "mcap-1.2.0.dist-info/RECORD", b"mcap/__init__.py,,\n"),
    ]
    for path, data in reversed(contents) if reverse else contents:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    kernel = Kernel(RELEASE, "vmlinuz", boot, folder / "modules")
    return Ingredients(kernel, folder / "root.tar", site)


def make_checkout(folder: Path) -> Path:
    """A git repository with what a card takes of this one, committed at one time."""
    listed = git(CHECKOUT, "ls-files", "-z", "--", "pi_firmware", "deploy", "pyproject.toml")
    for name in filter(None, listed.split("\0")):
        source, target = CHECKOUT / name, folder / name
        if os.path.lexists(source):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target, follow_symlinks=False)
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    commit(folder)
    return folder


def commit(folder: Path) -> None:
    """Commits everything, at one time and by nobody."""
    who = ("-c", "user.name=test", "-c", "user.email=test@localhost", "-c", "commit.gpgsign=false")
    git(folder, *who, "commit", "-q", "-a", "-m", "test", date=f"{EPOCH} +0000")


def git(folder: Path, *words: str, date: str = "") -> str:
    dates = {"GIT_AUTHOR_DATE": date, "GIT_COMMITTER_DATE": date} if date else {}
    command = ["git", "-c", f"safe.directory={folder}", "-C", folder, *words]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, env={**os.environ, **dates}
    ).stdout


class ImageReader:
    """Reads an image back by the tools of others: debugfs, mtools, dumpe2fs."""

    def __init__(self, image: Path, work: Path) -> None:
        self.image = image
        work.mkdir(parents=True, exist_ok=True)
        document = json.loads(self._run("sfdisk", "--json", str(image)))
        self.table = document["partitiontable"]
        self.parts = []
        with open(image, "rb") as file:
            for number, part in enumerate(self.table["partitions"]):
                file.seek(part["start"] * 512)
                place = work / f"part{number + 1}"
                place.write_bytes(file.read(part["size"] * 512))
                self.parts.append(place)
        self.boot, self.root, self.data = self.parts

    def debugfs(self, command: str, part: Path | None = None) -> str:
        return self._run("debugfs", "-R", command, str(part or self.root))

    def read(self, path: str) -> str:
        return self.debugfs(f'cat "/{path}"')

    def rows(self, path: str) -> dict[str, list[str]]:
        """A file of colons by its first fields."""
        rows = [line.split(":") for line in self.read(path).splitlines()]
        return {row[0]: row for row in rows}

    def exists(self, path: str) -> bool:
        return "Inode:" in self.debugfs(f'stat "/{path}"')

    def stat(self, path: str) -> dict[str, str]:
        """Mode (octal), uid, gid, type, target and mtime (s, hex) of a path of the root."""
        said = self.debugfs(f'stat "/{path}"')
        found = {"target": "", "mode": "", "mtime": ""}
        for line in said.splitlines():
            words = line.split()
            if "Type:" in words:
                found["type"] = words[words.index("Type:") + 1]
                found["mode"] = words[words.index("Mode:") + 1]
            elif words[:1] == ["User:"]:
                found["uid"], found["gid"] = words[1], words[3]
            elif words[:1] == ["mtime:"]:
                found["mtime"] = words[1]
            elif line.startswith("Fast link dest:"):
                found["target"] = line.split('"')[1]
        return found

    def boot_text(self, name: str) -> str:
        return self._run("mtype", "-i", str(self.boot), f"::{name}")

    def boot_names(self) -> set[str]:
        listed = self._run("mdir", "-b", "-/", "-i", str(self.boot), "::")
        return {line.removeprefix("::/") for line in listed.splitlines()}

    def facts(self, part: Path) -> dict[str, str]:
        lines = self._run("dumpe2fs", "-h", str(part)).splitlines()
        return {line.partition(":")[0]: line.partition(":")[2].strip() for line in lines}

    def check(self) -> None:
        """Fails where a file system is not clean."""
        for part in (self.root, self.data):
            run(["e2fsck", "-fn", part])
        run(["fsck.vfat", "-n", self.boot])

    @staticmethod
    def _run(*words: str) -> str:
        return run(words, env={"TZ": "UTC"}).decode()


_TOOLS = ("mke2fs", "debugfs", "e2fsck", "mkfs.vfat", "mcopy", "sfdisk", "bmaptool", "git")
needs_tools = pytest.mark.skipif(
    (lack := [tool for tool in _TOOLS if find(tool) is None]) != [],
    reason=f"not installed: {', '.join(lack)}",
)
