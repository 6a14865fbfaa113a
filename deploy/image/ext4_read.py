"""What an ext4 file system in a file holds, as a tree, read without mounting."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.tree import Content, Entry, Tree
from deploy.run import run

_ECHO = "debugfs: "
_LINE = re.compile(
    r"/\d+/(?P<mode>[0-7]+)/(?P<uid>\d+)/(?P<gid>\d+)/(?P<name>[^/]*)/(?P<size>\d*)/"
)
_VERSION = re.compile(r"debugfs \d")
_PERMISSIONS = 0o777
_TARGET = re.compile(r'^Fast link dest: "(.*)"$')


def read_tree(image: Path, wanted: Callable[[str], bool], work: Path) -> Tree:
    """All entries with owners, modes and links' targets; contents only of what is wanted.

    Args:
        image: the file system.
        wanted: tells by a path whether its content is needed; an entry without it cannot be read.
        work: a folder in which the contents stay.

    A target of 60 bytes and more, which lies outside its inode, stays empty.

    Raises:
        DeployError: no ext4, or damaged.
    """
    tree = Tree()
    folders = [""]
    while folders:
        listed = _each(image, work, [f'ls -p "/{folder}"' for folder in folders])
        below: list[str] = []
        for folder, lines in zip(folders, listed, strict=True):
            for path, entry in _entries(folder, lines):
                tree.put(path, entry)
                if entry.kind == "folder":
                    below.append(path)
        folders = below
    links = [path for path, entry in tree.items() if entry.kind == "link"]
    said = _each(image, work, [f'stat "/{path}"' for path in links])
    for path, lines in zip(links, said, strict=True):
        found = [match[1] for line in lines if (match := _TARGET.match(line))]
        tree.replace(path, target=found[0] if found else "")
    files = [path for path, entry in tree.items() if entry.kind == "file" and wanted(path)]
    places = [work / f"content-{number}" for number in range(len(files))]
    pairs = list(zip(files, places, strict=True))
    _each(image, work, [f'dump "/{path}" "{place}"' for path, place in pairs])
    for path, place in pairs:
        if not place.is_file():
            raise DeployError(f"{image.name}: /{path}: cannot be read")
        tree.replace(path, content=Content.at(place))
    return tree


def unpack(image: Path, tree: Tree, folder: Path) -> None:
    """Writes a file system to a new folder of the disk, with owners, modes and times; needs root.

    Not so device nodes, pipes, sockets and extended attributes; a file of two names becomes two.

    Args:
        image: the file system.
        tree: what `read_tree` gave for it.
        folder: made here.

    Raises:
        DeployError: damaged, or no room.
    """
    folder.mkdir()
    said = run(["debugfs", "-R", f'rdump / "{folder}"', image], merge=True)
    for line in said.decode(errors="replace").splitlines():
        if not _VERSION.match(line):
            raise DeployError(f"{image.name}: {line.strip()}")
    # debugfs gives permissions only; the bits above them come from the tree.
    for path, entry in tree.items():
        place = folder / path
        if entry.kind != "link" and entry.mode & ~_PERMISSIONS and os.path.lexists(place):
            place.chmod(entry.mode)


def _entries(folder: str, lines: Iterable[str]) -> Iterator[tuple[str, Entry]]:
    for line in lines:
        match = _LINE.fullmatch(line)
        if match is None or match["name"] in (".", ".."):
            continue
        mode = int(match["mode"], 8)
        path = f"{folder}/{match['name']}".lstrip("/")
        uid, gid = int(match["uid"]), int(match["gid"])
        if stat.S_ISDIR(mode):
            yield path, Entry("folder", mode & 0o7777, uid, gid)
        elif stat.S_ISLNK(mode):
            yield path, Entry("link", 0o777, uid, gid)
        else:
            # A device or pipe, too: it has no content that anybody wants.
            content = Content(size=int(match["size"] or 0))
            yield path, Entry("file", mode & 0o7777, uid, gid, content=content)


def _each(image: Path, work: Path, commands: list[str]) -> list[list[str]]:
    """What debugfs says to each command."""
    script = work / "questions"
    lines = "".join(f"{command}\n" for command in commands)
    script.write_bytes(lines.encode("utf-8", "surrogateescape"))
    said = run(["debugfs", "-f", script, image], merge=True).decode("utf-8", "surrogateescape")
    answers: list[list[str]] = []
    for line in said.splitlines():
        if line.startswith(_ECHO) and len(answers) < len(commands):
            answers.append([])
        elif answers:
            answers[-1].append(line)
    if len(answers) != len(commands):
        raise DeployError(f"{image.name}: no ext4 file system that debugfs reads")
    return answers
