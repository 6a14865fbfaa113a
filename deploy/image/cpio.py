"""Writes a cpio archive in the "new ASCII" form that the kernel unpacks as its first root.

Source of the format: the kernel's Documentation/driver-api/early-userspace/buffer-format.rst.
"""

from __future__ import annotations

import stat

from deploy.image.tree import Tree

_TYPES = {"file": stat.S_IFREG, "folder": stat.S_IFDIR, "link": stat.S_IFLNK}


def pack(tree: Tree) -> bytes:
    """The tree as an archive; times are 0 and inodes count from 1: same tree, same bytes."""
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
