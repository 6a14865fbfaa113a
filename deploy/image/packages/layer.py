"""What was changed in a folder, as a tar that lies over another tree: files new, other and gone.

A path that is gone stands in it as in the layers of the OCI image format (image-spec, layer.md,
"Whiteouts"): an empty file `.wh.NAME` in its folder.
"""

from __future__ import annotations

import io
import os
import stat
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

from deploy.image.packages.bytecode import unchecked
from deploy.image.tree import Tree

_GONE = ".wh."
_CAPABILITY = "security.capability"

# What tells one state of a file from another; of a folder only its mode and owners.
State = tuple[int, ...]


def snapshot(folder: Path, ignored: Callable[[str], bool]) -> dict[str, State]:
    """The state of every file, folder and link below a folder, by its path from there.

    Args:
        folder: looked through without following links.
        ignored: tells by a path whether it, and all below it, is none of ours.
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
