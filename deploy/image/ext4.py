"""An ext4 file system in a file, filled from a tree without mounting and without being root.

`mke2fs` makes it empty with a fixed identifier and hash seed; `debugfs` fills it from a script
that names every inode's owner, mode and time, in the tree's own order. So neither the builder's
user, nor the order in which his disk lists a folder, nor its times reach the image (as they do
with `mke2fs -d`), and two builds give the same bytes. E2FSPROGS_FAKE_TIME stands in for the clock.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.sparse import Range
from deploy.image.tree import Content, Entry, Tree, clamp
from deploy.run import run

BLOCK_BYTES = 4096
_INODE_BYTES = 256
_JOURNAL_MIB = 16
# A name is bytes; Python's way to carry those that are no UTF-8 through a text.
_NAMES = ("utf-8", "surrogateescape")

# Named here and not in the machine's /etc/mke2fs.conf, so that every builder makes the same.
_FEATURES = (
    "none,ext_attr,dir_index,filetype,extent,flex_bg,sparse_super,large_file,huge_file,dir_nlink,"
    "extra_isize,metadata_csum"
)
_FORMATS = {"file": 0o100000, "folder": 0o040000, "link": 0o120000}
# What debugfs says without being asked: its version, and what a command did.
_CHATTER = re.compile(r"debugfs \d|debugfs: |Allocated inode: |$")


def bytes_needed(tree: Tree) -> int:
    """What a file system for this tree must have at least, with its tables, in whole MiB."""
    blocks = sum(max(1, -(-entry.content.size // BLOCK_BYTES)) for _, entry in tree.items())
    tables = _inodes(tree) * _INODE_BYTES
    # Bitmaps and group descriptors are 2 blocks of 32768 each; extents and long folders the rest.
    needed = (blocks * BLOCK_BYTES + tables) * 1.02 + (4 << 20)
    return -(-int(needed) // (1 << 20)) << 20


def make(
    image: Path,
    size: int,
    tree: Tree,
    label: str,
    identifier: uuid.UUID,
    epoch: int,
    *,
    journal: bool = False,
) -> None:
    """Makes a file system of `size` bytes that holds the tree, and checks it.

    `journal` is for one that is written to in flight.

    Raises:
        DeployError: the tree does not fit, or a tool fails.
    """
    needed = bytes_needed(tree)
    if size < needed:
        raise DeployError(f"{label}: contents need {needed >> 20} MiB and get {size >> 20} MiB")
    image.unlink(missing_ok=True)
    with open(image, "wb") as file:
        file.truncate(size)
    features = _FEATURES + (",has_journal,resize_inode" if journal else "")
    extended = f"hash_seed={identifier},lazy_itable_init=0,lazy_journal_init=0,root_owner=0:0"
    # A journal and a share of inodes for the card's size, which this grows into.
    grows = ["-J", f"size={_JOURNAL_MIB}", "-i", "65536"]
    inodes = grows if journal else ["-N", str(_inodes(tree))]
    options = ["-b", str(BLOCK_BYTES), "-I", str(_INODE_BYTES), "-O", features, "-m", "0", *inodes]
    names = ["-L", label, "-U", str(identifier), "-E", extended]
    # A configuration of ours: /etc/mke2fs.conf is another on another machine.
    run(
        ["mke2fs", "-q", "-F", *options, *names, image],
        env={**clock(epoch), "MKE2FS_CONFIG": "/dev/null"},
    )
    fill(image, tree, epoch)


def fill(image: Path, tree: Tree, epoch: int, before: Tree | None = None) -> None:
    """Makes a file system hold the tree, where it holds `before` now (default: nothing).

    Entries that both trees share (the same object) are left as they are.

    Raises:
        DeployError: no room, or a tool fails.
    """
    with tempfile.TemporaryDirectory(dir=image.parent, prefix=".fill-") as work:
        script = Path(work) / "script"
        commands = _Commands(tree, before or Tree(), Path(work), epoch)
        lines = [*commands.removals(), *commands.additions()]
        script.write_bytes("".join(f"{line}\n" for line in lines).encode(*_NAMES))
        debugfs(image, script, epoch)
    run(["e2fsck", "-fn", image], env=clock(epoch))


def used_ranges(image: Path) -> list[Range]:
    """The stretches that matter on a card: all but free blocks, so empty tables and journal, too.

    Without these, an inode table or a journal that an earlier system left on the card at the same
    place would be taken for this one's.
    """
    said = _dumped(image)
    facts = _facts(said)
    block = int(facts["Block size"])
    size = int(facts["Block count"]) * block
    used: list[Range] = []
    position = 0
    for line in said.splitlines():
        # "  Free blocks: 27394-32767, 40000" below each group; the head's count is not indented.
        if not line.startswith("  Free blocks: "):
            continue
        for part in line.partition(": ")[2].replace(",", " ").split():
            first, _, last = part.partition("-")
            used.append(Range(position, int(first) * block))
            position = (int(last or first) + 1) * block
    used.append(Range(position, size))
    return [item for item in used if item.start < item.stop]


def facts(image: Path) -> dict[str, str]:
    """What the superblock says, by dumpe2fs's names."""
    return _facts(_dumped(image))


def _dumped(image: Path) -> str:
    return run(["dumpe2fs", image], env={"TZ": "UTC"}).decode(errors="replace")


def _facts(said: str) -> dict[str, str]:
    head = said.partition("\n\n")[0]
    return {
        name: value.strip()
        for name, colon, value in (line.partition(":") for line in head.splitlines())
        if colon
    }


class _Commands:
    """The debugfs script that makes one tree out of another."""

    def __init__(self, tree: Tree, before: Tree, work: Path, epoch: int) -> None:
        self._tree = tree
        self._before = dict(before.items())
        self._work = work
        self._epoch = epoch
        self._count = 0

    def removals(self) -> Iterator[str]:
        after = dict(self._tree.items())
        # Deepest first, so that a folder is empty when its turn comes.
        for path in reversed(self._before):
            old, new = self._before[path], after.get(path)
            if new is old or (new is not None and new.kind == old.kind == "folder"):
                continue
            yield f'{"rmdir" if old.kind == "folder" else "rm"} "/{path}"'

    def additions(self) -> Iterator[str]:
        for path, entry in self._tree.items():
            old = self._before.get(path)
            if entry is not old:
                exists = old is not None and old.kind == entry.kind == "folder"
                yield from self._make(path, entry, exists)

    def _make(self, path: str, entry: Entry, exists: bool) -> Iterator[str]:
        folder, _, name = path.rpartition("/")
        if not exists:
            # A new name goes into the current folder: `write` takes no other, and `mkdir "/x"`
            # means it by the empty name before the slash.
            yield f'cd "/{folder}"'
        if entry.kind == "folder" and not exists:
            yield f'mkdir "{name}"'
        elif entry.kind == "link":
            yield f'symlink "{name}" "{_quotable(entry.target)}"'
        elif entry.kind == "file":
            yield f'write "{self._source(entry)}" "{name}"'
        yield f'sif "/{path}" mode 0{_FORMATS[entry.kind] | entry.mode:o}'
        yield f'sif "/{path}" mtime @{clamp(entry, self._epoch)}'
        if entry.uid or exists:
            yield f'sif "/{path}" uid {entry.uid}'
        if entry.gid or exists:
            yield f'sif "/{path}" gid {entry.gid}'
        for key, value in entry.xattrs:
            yield f'ea_set -f "{self._stored(value)}" "/{path}" {key}'

    def _source(self, entry: Entry) -> Path:
        content = entry.content
        if content.path is not None and not content.offset:
            return Path(_quotable(str(content.path.resolve())))
        return self._stored(content.read())

    def _stored(self, data: bytes) -> Path:
        path = self._work / str(self._count)
        self._count += 1
        path.write_bytes(data)
        return path


def debugfs(image: Path, script: Path, epoch: int) -> None:
    """Runs a script of debugfs commands; it exits with 0 whatever fails, so its words are read."""
    said = run(["debugfs", "-w", "-f", script, image], env=clock(epoch), merge=True)
    for line in said.decode(errors="replace").splitlines():
        if not _CHATTER.match(line):
            raise DeployError(f"{image.name}: debugfs: {line.strip()}")


def _quotable(text: str) -> str:
    if any(character in text for character in '\n\r\0"'):
        raise DeployError(f"{text!r}: a name with a line break or a quote")
    return text


def clock(epoch: int) -> dict[str, str]:
    """The environment in which e2fsprogs takes this for the present."""
    # e2fsck has a name of its own for it.
    return {"E2FSPROGS_FAKE_TIME": str(epoch), "E2FSCK_TIME": str(epoch), "TZ": "UTC"}


def _inodes(tree: Tree) -> int:
    # A few to spare; the first 10 are the file system's own.
    return len(tree) + 64


_ECHO = "debugfs: "
_LINE = re.compile(
    r"/\d+/(?P<mode>[0-7]+)/(?P<uid>\d+)/(?P<gid>\d+)/(?P<name>[^/]*)/(?P<size>\d*)/"
)
_VERSION = re.compile(r"debugfs \d")
_PERMISSIONS = 0o777
_TARGET = re.compile(r'^Fast link dest: "(.*)"$')


def read_tree(image: Path, wanted: Callable[[str], bool], work: Path) -> Tree:
    """All entries with owners, modes and links' targets; contents only of what is wanted.

    `wanted` tells by a path whether its content is needed, which then lies in the folder `work`; an
    entry without it cannot be read. A target of 60 bytes and more, which lies outside its inode,
    stays empty. Raises `DeployError` for what is no ext4, or damaged.
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
    `tree` is what `read_tree` gave for it. Raises `DeployError` when it is damaged or has no room.
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
