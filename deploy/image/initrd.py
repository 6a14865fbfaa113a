"""The first root in memory: busybox, the modules that reach the card, and `initrd.sh`.

Built natively from the target's own files, without running any: mkinitramfs under emulation takes a
quarter of an hour.
"""

from __future__ import annotations

import gzip
import lzma
from pathlib import Path

from deploy.errors import DeployError
from deploy.image import cpio
from deploy.image.tree import Tree
from deploy.run import run

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

    Args:
        tree: the root, with busybox-static and `usr/lib/modules/RELEASE` with depmod's tables.
        release: the kernel's, as `uname -r` says.

    Raises:
        DeployError: busybox, the tables or a needed module is missing.
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
    return gzip.compress(cpio.pack(root), 9, mtime=0)


def load_order(tree: Tree, release: str) -> list[str]:
    """The modules' paths in the tree, each after those that it depends on."""
    base = f"usr/lib/modules/{release}"
    needs: dict[str, list[str]] = {}
    for line in tree.read(f"{base}/modules.dep").decode().splitlines():
        path, _, others = line.partition(":")
        needs[path] = others.split()
    paths = {_name(path): path for path in needs}
    builtin = {_name(line) for line in _lines(tree, f"{base}/modules.builtin")}
    soft: dict[str, list[str]] = {}
    for line in _lines(tree, f"{base}/modules.softdep"):
        words = line.split()
        if words[:1] == ["softdep"] and "pre:" in words:
            after = words[words.index("pre:") + 1 :]
            stop = after.index("post:") if "post:" in after else len(after)
            soft[_name(words[1])] = after[:stop]
    aliases = {
        words[1]: words[2]
        for words in (line.split() for line in _lines(tree, f"{base}/modules.alias"))
        if len(words) == 3
    }
    order: list[str] = []

    def take(path: str) -> None:
        if path in order:
            return
        for name in soft.get(_name(path), []):
            other = paths.get(_name(name)) or paths.get(_name(aliases.get(name, "")))
            # ext4 asks for its checksum by what that does and not by the module's name.
            stem = _name(name).removeprefix("crypto_")
            if other is not None:
                take(other)
            elif not any(stem in known for known in builtin):
                raise DeployError(f"/{base}: no {name}, which {_name(path)} asks for")
        # depmod lists the nearest first.
        for other in reversed(needs[path]):
            take(other)
        if path not in order:
            order.append(path)

    for name in (*_WELCOME, *_NEEDED):
        if _name(name) in paths:
            take(paths[_name(name)])
        elif name in _NEEDED and _name(name) not in builtin:
            raise DeployError(f"/{base}: no {name}, neither as a module nor built in")
    return [f"{base}/{path}" for path in order]


def _name(path: str) -> str:
    return path.rpartition("/")[2].partition(".ko")[0].replace("-", "_")


def _lines(tree: Tree, path: str) -> list[str]:
    return tree.read(path).decode().splitlines() if path in tree else []


def _unpacked(path: str, data: bytes) -> bytes:
    """A module as `insmod` of busybox takes it: uncompressed."""
    if path.endswith(".xz"):
        return lzma.decompress(data)
    if path.endswith(".gz"):
        return gzip.decompress(data)
    if path.endswith(".zst"):
        return run(["zstd", "-dc"], input=data)
    return data
