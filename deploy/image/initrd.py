"""The first root in memory: busybox, the modules that reach the card, and `initrd.sh`.

Built natively from the target's own files, without running any: mkinitramfs under emulation takes a
quarter of an hour.
"""

from __future__ import annotations

import gzip
import lzma
import stat
from collections.abc import Callable
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.tree import Tree
from deploy.run import run

_TYPES = {"file": stat.S_IFREG, "folder": stat.S_IFDIR, "link": stat.S_IFLNK}
_SCRIPT = Path(__file__).with_name("initrd.sh")
_BUSYBOX = "usr/bin/busybox"
_APPLETS = ("sh", "cat", "chmod", "cut", "echo", "findfs", "insmod", "mkdir", "mount", "reboot",
            "sha256sum", "sleep", "switch_root", "tr", "usleep")  # fmt: skip

# Without these there is no root: as modules or in the kernel itself.
_NEEDED = ("ext4", "overlay")
# Where the card hangs, and what can start the board again, if they are not built in.
_WELCOME = ("bcm2835", "sdhci-iproc", "mmc_block", "virtio_mmio", "virtio_pci", "virtio_blk",
            "bcm2835_wdt")  # fmt: skip


def build(tree: Tree, release: str) -> bytes:
    """The compressed archive for a kernel whose modules lie in the tree.

    That is `usr/lib/modules/RELEASE` with depmod's tables, RELEASE as `uname -r` says. Raises
    `DeployError` when busybox, the tables or a needed module is missing.
    """
    if _BUSYBOX not in tree:
        raise DeployError(f"/{_BUSYBOX}: not there; the root needs the package busybox-static")
    root = Tree()
    for folder in ("dev", "proc", "sys", "modules"):
        root.folder(folder)
    root.write("bin/busybox", tree.read(_BUSYBOX), 0o755)
    for applet in _APPLETS:
        root.link(f"bin/{applet}", "busybox")
    root.write("init", _SCRIPT.read_bytes(), 0o755)
    for number, path in enumerate(load_order(tree, release)):
        name = path.rpartition("/")[2].partition(".ko")[0]
        root.write(f"modules/{number:02d}-{name}.ko", _unpacked(path, tree.read(path)))
    # No name and no time in the head; the slowest level costs a second here, once.
    return gzip.compress(pack(root), 9, mtime=0)


class Modules:
    """A kernel's modules by depmod's tables; `-` and `_` are the same in a name.

    `paths` are by name, `needs` by path, the nearest first; `before` and `after` what a module's
    softdep asks for, in names that may be aliases. `lines` gives those of a table, by its name.
    """

    def __init__(self, lines: Callable[[str], list[str]]) -> None:
        self.paths: dict[str, str] = {}
        self.needs: dict[str, list[str]] = {}
        for line in lines("modules.dep"):
            path, _, others = line.partition(":")
            self.paths[name_of(path)] = path
            self.needs[path] = others.split()
        self.builtin = {name_of(line) for line in lines("modules.builtin")}
        self._aliases: dict[str, list[str]] = {}
        for line in lines("modules.alias"):
            if len(words := line.split()) == 3 and words[0] == "alias":
                self._aliases.setdefault(name_of(words[1]), []).append(name_of(words[2]))
        self.before: dict[str, list[str]] = {}
        self.after: dict[str, list[str]] = {}
        for line in lines("modules.softdep"):
            asked, words = self.before, line.split()
            for word in words[2:] if words[:1] == ["softdep"] else ():
                if word in ("pre:", "post:"):
                    asked = self.before if word == "pre:" else self.after
                else:
                    asked.setdefault(name_of(words[1]), []).append(name_of(word))

    def behind(self, asked: str) -> list[str]:
        """Paths of what stands behind a name: its own, then those that it is an alias of."""
        names = [asked, *reversed(self._aliases.get(asked, []))]
        return [self.paths[name] for name in names if name in self.paths]


def load_order(tree: Tree, release: str) -> list[str]:
    """The modules' paths in the tree, each after those that it depends on."""
    base = f"usr/lib/modules/{release}"
    modules = Modules(lambda table: _lines(tree, f"{base}/{table}"))
    order: list[str] = []

    def take(path: str) -> None:
        if path in order:
            return
        for name in modules.before.get(name_of(path), []):
            # ext4 asks for its checksum by what that does and not by the module's name.
            stem = name.removeprefix("crypto_")
            if behind := modules.behind(name):
                take(behind[0])
            elif not any(stem in known for known in modules.builtin):
                raise DeployError(f"/{base}: no {name}, which {name_of(path)} asks for")
        for other in reversed(modules.needs[path]):
            take(other)
        if path not in order:
            order.append(path)

    for name in (*_WELCOME, *_NEEDED):
        if name_of(name) in modules.paths:
            take(modules.paths[name_of(name)])
        elif name in _NEEDED and name_of(name) not in modules.builtin:
            raise DeployError(f"/{base}: no {name}, neither as a module nor built in")
    return [f"{base}/{path}" for path in order]


def name_of(path: str) -> str:
    """A module's name, from its path or another writing of it."""
    return path.rpartition("/")[2].partition(".ko")[0].replace("-", "_")


def _lines(tree: Tree, path: str) -> list[str]:
    return tree.read(path).decode().splitlines() if path in tree else []


def pack(tree: Tree) -> bytes:
    """The tree as a cpio archive in the "new ASCII" form, which the kernel unpacks as a root.

    Times are 0 and inodes count from 1: same tree, same bytes. Source of the format: the kernel's
    Documentation/driver-api/early-userspace/buffer-format.rst.
    """
    parts: list[bytes] = []
    for number, (path, entry) in enumerate(tree.items(), start=1):
        is_file = entry.kind == "file"
        data = entry.content.read() if is_file else entry.target.encode()
        mode = _TYPES[entry.kind] | entry.mode
        links = 2 if entry.kind == "folder" else 1
        parts += _member(path, number, mode, entry.uid, entry.gid, links, data)
    parts += _member("TRAILER!!!", 0, 0, 0, 0, 1, b"")
    return b"".join(parts)


def _member(
    path: str, number: int, mode: int, uid: int, gid: int, links: int, data: bytes
) -> list[bytes]:
    name = path.encode() + b"\0"
    # inode mode uid gid nlink mtime filesize dev(2) rdev(2) namesize check
    fields = (number, mode, uid, gid, links, 0, len(data), 0, 0, 0, 0, len(name), 0)
    header = b"070701" + b"".join(b"%08X" % value for value in fields)
    return [header, name, bytes(-(len(header) + len(name)) % 4), data, bytes(-len(data) % 4)]


def _unpacked(path: str, data: bytes) -> bytes:
    """A module as `insmod` of busybox takes it: uncompressed."""
    if path.endswith(".xz"):
        return lzma.decompress(data)
    if path.endswith(".gz"):
        return gzip.decompress(data)
    if path.endswith(".zst"):
        return run(["zstd", "-dc"], input=data)
    return data
