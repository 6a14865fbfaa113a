"""Packages that a base image lacks, installed into its root by its own apt.

The base's own sources and keys say where packages come from, as on the board itself: Raspberry Pi
OS's are the only ones built for ARMv6. Its programs run in a chroot, emulated. Kept is what that
changed, so that nothing else of the base is ever written again: a layer, a tar that lies over
another tree. A path that is gone stands in it as in the layers of the OCI image format (image-spec,
layer.md, "Whiteouts"): an empty file `.wh.NAME` in its folder.
"""

from __future__ import annotations

import fnmatch
import io
import os
import shutil
import stat
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.ext4 import unpack
from deploy.image.packages import apt, cache, foreign, libraries
from deploy.image.packages.board import Board, Group
from deploy.image.packages.foreign import run_long
from deploy.image.packages.python import unchecked
from deploy.image.tree import Tree

_HERE = Path(__file__).parent
# Raised when this module makes another layer of the same inputs.
_RECIPE = 1
# Beside the base's unpacked root: downloads, what they unpack to, and the layer.
_ROOM_BYTES = 3 << 30

_SETTINGS = "etc/apt/apt.conf.d/zz-blimp"
_OPTIONS = (
    'APT::Get::Show-Upgraded "false";\n'
    'Dpkg::Use-Pty "0";\n'
    # All is thrown away unless it ends well; files of settings stay as the base has them.
    'DPkg::Options { "--force-unsafe-io"; "--force-confdef"; "--force-confold"; };\n'
)
# Of the builder's environment, what names places that the chroot has not.
_NOT_INSIDE = ("TMPDIR", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "LD_PRELOAD")
# What the work itself leaves, or what is another in each build; a pattern ends with `*`.
_NOT_KEPT = (
    _SETTINGS, "etc/resolv.conf", "usr/sbin/policy-rc.d", "var/lib/man-db/auto-update",
    "etc/initramfs-tools/update-initramfs.conf", "etc/machine-id", "etc/.pwd.lock",
    *(f"etc/{name}-" for name in ("passwd", "group", "shadow", "gshadow", "subuid", "subgid")),
    "etc/ssh/ssh_host_*", "var/lib/dpkg/status-old", "var/lib/dpkg/diversions-old",
    "var/lib/dpkg/statoverride-old", "var/lib/dpkg/lock*", "var/lib/dpkg/triggers/Lock",
    "var/lib/systemd/catalog/database", "var/lib/apt", "var/cache", "var/log", "var/tmp",
    "dev", "proc", "run", "sys", "tmp",
)  # fmt: skip


def add_packages(
    board: Board,
    base: str,
    file_system: Path,
    tree: Tree,
    missing: Sequence[str],
    cache_folder: Path,
) -> Path:
    """The layer that installing packages puts over a base's root: made once, then from the cache.

    Which versions come is what the base's sources have on that day: the same base and the same
    cache give the same card, another day's cache may not. The card's manifest lists them.

    `base` is the base image's SHA-256, `file_system` its root's, which is only read, and `tree`
    what `ext4.read_tree` gave for it. Layers are kept in `cache_folder` as `base-BOARD-KEY.tar`.

    Raises:
        DeployError: not root, no emulator, no room, a source is out of reach or not trusted, a
            package isn't there or doesn't install; nothing half-made is left. What the tools said
            then stands in `base-BOARD.log` there.
    """
    made_by = (_RECIPE, *(_HERE / name for name in ("install.sh", "plugins.sh", "base.py")))
    names = sorted(missing)
    key = cache.key(base, board.architecture, names, board.left_out, *made_by)
    target = cache_folder / f"base-{board.name}-{key}.tar"
    with cache.made(target) as work:
        if work is None:
            return target
        if os.geteuid() != 0:
            raise DeployError(
                f"packages are added to a base as root: sudo (once; kept in {cache_folder})"
            )
        emulated = foreign.prefix(board.architecture)
        free = shutil.disk_usage(work).free
        needed = _ROOM_BYTES + file_system.stat().st_size
        if free < needed:
            raise DeployError(
                f"{cache_folder}: {free >> 20} MiB free; the base's root and its new packages "
                f"need {needed >> 20} MiB"
            )
        root = work / "root"
        unpack(file_system, tree, root)
        before = snapshot(root, _not_kept)
        lacked = set(libraries.missing(root))
        (root / _SETTINGS).parent.mkdir(parents=True, exist_ok=True)
        (root / _SETTINGS).write_text(apt.SETTINGS + _OPTIONS)
        clean = ["env", *(f"--unset={name}" for name in _NOT_INSIDE)]
        inside = [*emulated, *clean, "unshare", "--mount", "sh"]
        environment = {
            **foreign.environment(),
            "DEBIAN_FRONTEND": "noninteractive",
            "APT_LISTCHANGES_FRONTEND": "none",
            # Byte code of the same sources is then the same.
            "PYTHONHASHSEED": "0",
            "SYSTEMD_OFFLINE": "1",
        }
        log = cache_folder / f"base-{board.name}.log"
        words = [*inside, str(_HERE / "install.sh"), str(root), *names]
        run_long(words, log, f"packages of {board.name}", environment)
        leave_out(root, before, board.left_out)
        words = [*inside, str(_HERE / "plugins.sh"), str(root)]
        run_long(
            words, log.with_stem(f"{log.stem}-plugins"), f"plugins of {board.name}", environment
        )
        if lost := sorted(set(libraries.missing(root)) - lacked):
            raise DeployError(f"packages of {board.name}: misses a library: {lost[0]}")
        write(root, before, snapshot(root, _not_kept), work / target.name)
    return target


def leave_out(root: Path, before: dict[str, State], rules: Sequence[Group]) -> None:
    """Takes what is new and left out on purpose from a root; what the base had, it keeps.

    dpkg itself, told so, would leave it out of an upgrade of the base's own packages, too. As with
    dpkg, the last rule that fits counts.
    """
    patterns = [name for group in rules for name in group.names]
    states = snapshot(root, _not_kept)
    # What lies in a folder goes before it.
    for path in sorted(states.keys() - before.keys(), reverse=True):
        fits = [name for name in patterns if fnmatch.fnmatchcase(f"/{path}", name.lstrip("!"))]
        if not fits or fits[-1].startswith("!"):
            continue
        if not stat.S_ISDIR(states[path][0]):
            (root / path).unlink()
        elif not any((root / path).iterdir()):
            (root / path).rmdir()


def _not_kept(path: str) -> bool:
    return any(fnmatch.fnmatchcase(path, pattern) for pattern in _NOT_KEPT)


_GONE = ".wh."
_CAPABILITY = "security.capability"

# What tells one state of a file from another; of a folder only its mode and owners.
State = tuple[int, ...]


def snapshot(folder: Path, ignored: Callable[[str], bool]) -> dict[str, State]:
    """The state of every file, folder and link below a folder, by its path from there.

    `ignored` tells by a path whether it, and all below it, is none of ours.
    """
    return dict(_states(folder, "", ignored))


def _states(top: Path, folder: str, ignored: Callable[[str], bool]) -> Iterator[tuple[str, State]]:
    with os.scandir(top / folder) as entries:
        for entry in entries:
            path = f"{folder}{entry.name}"
            if ignored(path):
                continue
            facts = entry.stat(follow_symlinks=False)
            state: State = (facts.st_mode, facts.st_uid, facts.st_gid)
            if entry.is_dir(follow_symlinks=False):
                yield path, state
                yield from _states(top, f"{path}/", ignored)
            elif entry.is_file(follow_symlinks=False) or entry.is_symlink():
                # Not the time of its inode: a second name that came and went changes nothing.
                yield path, (*state, facts.st_ino, facts.st_size, facts.st_mtime_ns)


def write(folder: Path, before: dict[str, State], after: dict[str, State], target: Path) -> None:
    """Writes what lies between two snapshots of a folder as a tar, sorted.

    Owners, modes and capabilities are the folder's. Byte code no longer asks for its source's time,
    which a card's may not keep. Folders above a change are in it as they are.
    """
    gone = {path for path, old in before.items() if not _same_kind(old, after.get(path))}
    # A folder that is gone takes what was in it along.
    gone = {path for path in gone if not any(above in gone for above in _above(path))}
    changed = {path for path, state in after.items() if before.get(path) != state}
    folders = {above for path in (*changed, *gone) for above in _above(path)}
    with tarfile.open(target, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in sorted(gone):
            head, _, name = path.rpartition("/")
            tar.addfile(tarfile.TarInfo(f"{head}/{_GONE}{name}".lstrip("/")))
        for path in sorted(changed | (folders & after.keys())):
            _add(tar, folder / path, path)


def _add(tar: tarfile.TarFile, place: Path, path: str) -> None:
    member = tar.gettarinfo(place, path)
    member.uname = member.gname = ""
    member.mtime = int(member.mtime)
    if not member.isreg():
        tar.addfile(member)
        return
    if _CAPABILITY in os.listxattr(place, follow_symlinks=False):
        value = os.getxattr(place, _CAPABILITY, follow_symlinks=False)
        text = value.decode("utf-8", "surrogateescape")
        member.pax_headers = {f"SCHILY.xattr.{_CAPABILITY}": text}
    if place.suffix == ".pyc" and place.parent.name == "__pycache__":
        data = unchecked(place.read_bytes())
        member.size = len(data)
        tar.addfile(member, io.BytesIO(data))
        return
    with place.open("rb") as file:
        tar.addfile(member, file)


def lay_over(tree: Tree, layer: Tree) -> None:
    """Changes a tree as a layer says; what the layer doesn't name stays the very entry it was."""
    entries = list(layer.items())
    for path, _ in entries:
        head, _, name = path.rpartition("/")
        if name.startswith(_GONE):
            tree.remove(f"{head}/{name.removeprefix(_GONE)}")
    for path, entry in entries:
        if path.rpartition("/")[2].startswith(_GONE):
            continue
        old = tree[path] if entry.kind == "folder" and path in tree else entry
        same = (old.kind, old.mode, old.uid, old.gid) == (
            "folder",
            entry.mode,
            entry.uid,
            entry.gid,
        )
        if old is entry or not same:
            tree.put(path, entry)


def _same_kind(old: State, new: State | None) -> bool:
    return new is not None and stat.S_IFMT(old[0]) == stat.S_IFMT(new[0])


def _above(path: str) -> list[str]:
    parts = path.split("/")[:-1]
    return ["/".join(parts[:count]) for count in range(1, len(parts) + 1)]
