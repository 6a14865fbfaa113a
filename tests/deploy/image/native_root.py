"""A root that apt runs in: this machine's own programs, copied, so that nothing is emulated."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.image.tree import Content, Entry, Tree
from deploy.run import find

# What apt, dpkg and the scripts that they run call.
_PROGRAMS = (
    "sh", "apt-get", "apt-config", "apt-key", "dpkg", "dpkg-deb", "dpkg-split", "dpkg-query", "tar",
    "gpgv", "gpgconf", "rm", "mkdir", "chmod", "chown", "cat", "ls", "mktemp", "find", "grep",
    "sed", "tr", "cut", "id", "touch", "readlink", "cmp", "diff", "ldconfig", "start-stop-daemon",
    "true", "sort", "env", "head", "basename", "dirname", "ln", "mv", "cp", "stat", "echo", "sleep",
)  # fmt: skip
_OPTIONAL = ("apt-key", "gpgconf", "sqv")
_METHODS = Path("/usr/lib/apt/methods")
_TABLES = Path("/usr/share/dpkg")


def add_programs(tree: Tree) -> None:
    """Adds apt, dpkg and what they need to a tree; skips the test where this system lacks one."""
    programs = {name: find(name) for name in (*_PROGRAMS, "sqv")}
    lacking = [name for name, path in programs.items() if path is None and name not in _OPTIONAL]
    if lacking or not _METHODS.is_dir() or not _TABLES.is_dir():
        pytest.skip(f"needs the programs of a Debian: {', '.join(lacking) or _METHODS}")
    if "lib64" not in tree:
        tree.link("lib64", "usr/lib64")
    files = [Path(path) for path in programs.values() if path is not None]
    files += [_METHODS / name for name in ("file", "copy", "store", "http", "gpgv", "sqv")]
    files += list(_TABLES.glob("*table"))
    for file in files:
        if not file.exists():
            continue
        for place in (file, *_libraries(file)):
            _add(tree, place)


def _add(tree: Tree, place: Path) -> None:
    content = Content.at(place.resolve())
    # Merged /usr, whatever the name that the program was found by.
    path = str(place).lstrip("/")
    tree.add(
        path if path.startswith("usr/") else f"usr/{path}",
        Entry("file", 0o755, 0, 0, content=content),
    )


def _libraries(program: Path) -> Iterator[Path]:
    done = subprocess.run(["ldd", str(program)], capture_output=True, text=True, check=False)
    for line in done.stdout.splitlines():
        if found := re.search(r"(/\S+) \(0x", line):
            yield Path(found[1])
