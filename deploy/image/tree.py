"""A file tree in memory: what a file system shall hold, whoever builds it, root or not.

Owners, modes and times stand in a table and not on the builder's disk, so that nothing depends on
who extracts a tar, in which order a folder lists its files or when that was. Contents stay where
they are (inside a tar, in a file) until a file system is written.
"""

from __future__ import annotations

import hashlib
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from deploy.errors import DeployError

Kind = Literal["file", "folder", "link"]

# Linux follows at most so many symbolic links in one path (path_resolution(7)).
_MAX_LINKS = 40


@dataclass(frozen=True)
class Content:
    """The bytes of a file: held here, or a stretch of a file on disk."""

    data: bytes | None = None
    path: Path | None = None
    offset: int = 0
    size: int = 0

    @staticmethod
    def of(data: bytes) -> Content:
        return Content(data=data, size=len(data))

    @staticmethod
    def at(path: Path) -> Content:
        return Content(path=path, size=path.stat().st_size)

    def read(self) -> bytes:
        if self.data is not None:
            return self.data
        if self.path is None:
            raise DeployError("a file's content is asked for that was not read")
        try:
            with open(self.path, "rb") as file:
                file.seek(self.offset)
                data = file.read(self.size)
        except OSError as error:
            raise DeployError(f"{self.path}: {error.strerror or error}") from None
        if len(data) != self.size:
            raise DeployError(f"{self.path}: cut at byte {self.offset + len(data)}")
        return data


@dataclass(frozen=True)
class Entry:
    """A file, folder or symbolic link; `mode` is the permission bits (0 to 0o7777)."""

    kind: Kind
    mode: int
    uid: int = 0
    gid: int = 0
    mtime: int | None = None  # s since 1970; None: the build's epoch
    content: Content = field(default_factory=Content)  # of a file
    target: str = ""  # of a link
    xattrs: tuple[tuple[str, bytes], ...] = ()


class Tree:
    """Entries by their path, relative to the root and without a leading slash."""

    def __init__(self, entries: Mapping[str, Entry] | None = None) -> None:
        self._entries = dict(entries or {})

    @staticmethod
    def from_tar(path: Path) -> Tree:
        """What an uncompressed tar holds, in it; device nodes and sockets are left out.

        Raises:
            DeployError: no tar, cut, or with a path that leaves the root.
        """
        tree = Tree()
        try:
            with tarfile.open(path, "r:") as tar:
                for member in tar:
                    tree._take(path, member)
        except (OSError, tarfile.TarError) as error:
            raise DeployError(f"{path}: no readable tar: {error}") from None
        for name in list(tree._entries):
            tree._above(name)
        return tree

    def _take(self, tar: Path, member: tarfile.TarInfo) -> None:
        name = _checked(member.name)
        if not name:
            return
        mode = member.mode & 0o7777
        # Capabilities, but no access lists: the only ones are of /var/log, which is not shipped.
        xattrs = tuple(
            (key.removeprefix("SCHILY.xattr."), value.encode("utf-8", "surrogateescape"))
            for key, value in sorted(member.pax_headers.items())
            if key.startswith("SCHILY.xattr.security.")
        )
        owned = Entry("file", mode, member.uid, member.gid, int(member.mtime), xattrs=xattrs)
        if member.isdir():
            self._entries[name] = replace(owned, kind="folder")
        elif member.issym():
            self._entries[name] = replace(owned, kind="link", mode=0o777, target=member.linkname)
        elif member.islnk():
            # A second name gets its own copy: one inode with two names is worth nothing on a
            # file system that is never written.
            self._entries[name] = self[_checked(member.linkname)]
        elif member.isreg():
            content = Content(path=tar, offset=member.offset_data, size=member.size)
            self._entries[name] = replace(owned, content=content)

    def resolve(self, path: str, *, last: bool = False) -> str:
        """The path with its folders' links followed: `lib/x` is `usr/lib/x` on a merged /usr.

        With `last` a link at its end is followed, too.
        """
        done: list[str] = []
        todo = _checked(path).split("/")
        links = 0
        while todo:
            part = todo.pop(0)
            if part in ("", "."):
                continue
            if part == "..":
                done = done[:-1]
                continue
            here = "/".join([*done, part])
            entry = self._entries.get(here)
            if entry is not None and entry.kind == "link" and (todo or last):
                links += 1
                if links > _MAX_LINKS:
                    raise DeployError(f"{path}: more than {_MAX_LINKS} links")
                if entry.target.startswith("/"):
                    done = []
                todo = entry.target.strip("/").split("/") + todo
            else:
                done.append(part)
        return "/".join(done)

    def add(self, path: str, entry: Entry) -> None:
        """Puts an entry into its place, with the folders above it, over what was there."""
        place = self.resolve(path)
        if not place:
            raise DeployError(f"'{path}' names no file")
        self._above(place)
        old = self._entries.get(place)
        if old is not None and old.kind == "folder" and entry.kind != "folder":
            raise DeployError(f"{path}: a folder is there already")
        self._entries[place] = entry

    def _above(self, place: str) -> None:
        """Makes the folders above a place that are not there."""
        parent = place.rpartition("/")[0]
        if parent and parent not in self._entries:
            self._entries[parent] = Entry("folder", 0o755)
            self._above(parent)
        elif parent and self._entries[parent].kind != "folder":
            raise DeployError(f"{place}: {parent} is no folder")

    def write(
        self, path: str, data: bytes | str, mode: int = 0o644, uid: int = 0, gid: int = 0
    ) -> None:
        """A file with these bytes."""
        raw = data.encode() if isinstance(data, str) else data
        self.add(path, Entry("file", mode, uid, gid, content=Content.of(raw)))

    def folder(self, path: str, mode: int = 0o755, uid: int = 0, gid: int = 0) -> None:
        self.add(path, Entry("folder", mode, uid, gid))

    def link(self, path: str, target: str) -> None:
        self.add(path, Entry("link", 0o777, target=target))

    def take(self, base: Path, files: Iterable[str], into: str = "") -> None:
        """Files of the disk, by their names below `base`, to the same names below `into`."""
        for name in files:
            self.take_file(base / name, f"{into}/{name}")

    def take_file(self, source: Path, path: str) -> None:
        """A file of the disk: root's, 644 or 755 as git keeps it; a link stays one."""
        if source.is_symlink():
            self.link(path, str(source.readlink()))
            return
        try:
            mode = 0o755 if source.stat().st_mode & 0o100 else 0o644
            self.add(path, Entry("file", mode, content=Content.at(source)))
        except OSError as error:
            raise DeployError(f"{source}: {error.strerror or error}") from None

    def remove(self, path: str) -> None:
        """Takes a file, link or whole folder away; nothing there is no error."""
        place = self.resolve(path)
        for name in [n for n in self._entries if n == place or n.startswith(place + "/")]:
            del self._entries[name]

    def replace(self, path: str, **changes: Any) -> None:
        """Changes an entry's fields, by their names."""
        place = path if path in self._entries else self.resolve(path)
        self._entries[place] = replace(self[place], **changes)

    def put(self, path: str, entry: Entry) -> None:
        """Puts an entry under exactly this path, as a file system that is read has it."""
        self._entries[_checked(path)] = entry

    def __contains__(self, path: str) -> bool:
        return self.resolve(path) in self._entries

    def __getitem__(self, path: str) -> Entry:
        try:
            return self._entries[self.resolve(path)]
        except KeyError:
            raise DeployError(f"/{path}: not in the file tree") from None

    def __len__(self) -> int:
        return len(self._entries)

    def read(self, path: str) -> bytes:
        """A file's bytes, through symbolic links."""
        entry = self[self.resolve(path, last=True)]
        if entry.kind != "file":
            raise DeployError(f"/{path}: not a file")
        return entry.content.read()

    def items(self) -> Iterator[tuple[str, Entry]]:
        """All entries, each after its folder, in an order that nothing else has a hand in."""
        # By parts, so that a folder's contents follow it whatever sorts below the slash.
        for path in sorted(self._entries, key=lambda name: name.split("/")):
            yield path, self._entries[path]

    def below(self, folder: str) -> Iterator[tuple[str, Entry]]:
        """The entries inside a folder, by their path from the root."""
        place = self.resolve(folder) + "/"
        return ((path, entry) for path, entry in self.items() if path.startswith(place))

    def copy(self) -> Tree:
        """A tree of the very same entries."""
        return Tree(self._entries)

    def changed(self, before: Tree) -> Tree:
        """The entries that are not the very ones of another tree."""
        mine = self._entries.items()
        return Tree({path: one for path, one in mine if before._entries.get(path) is not one})

    def digest(self, epoch: int) -> bytes:
        """SHA-256 over every path, owner, mode, time and content."""
        whole = hashlib.sha256()
        for path, entry in self.items():
            head = (path, entry.kind, entry.mode, entry.uid, entry.gid, clamp(entry, epoch))
            whole.update(repr((*head, entry.target, entry.xattrs)).encode())
            if entry.kind == "file":
                whole.update(hashlib.sha256(entry.content.read()).digest())
        return whole.digest()


def clamp(entry: Entry, epoch: int) -> int:
    """The time that an entry gets: its own, at most the epoch.

    Kept and not set to the epoch, since Python's compiled files hold their source's time.
    """
    return epoch if entry.mtime is None else max(0, min(entry.mtime, epoch))


def _checked(name: str) -> str:
    """A path without `./`; refuses what leaves the root or what a script line cannot hold."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise DeployError(f"{name!r}: a path that leaves the root")
    if any(character in name for character in '\n\r\0"'):
        raise DeployError(f"{name!r}: a path with a line break or a quote")
    return "/".join(parts)
