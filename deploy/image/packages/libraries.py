"""Checks that every program on the card finds the shared libraries that it names.

    python -m deploy.image.packages.libraries ROOT

Packages' files are left out on purpose (`left_out`); this says when one too many was. It asks
readelf(1), which knows every machine's files, so that no program of the board is run.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from deploy.errors import DeployError
from deploy.run import run

# Where a program, or what a program loads by name, lies; libraries are looked for from these on.
_PROGRAMS = ("usr/bin", "usr/sbin", "usr/libexec", "usr/lib/systemd", "usr/lib/openssh")
_LOADED = ("gstreamer-1.0", "gstreamer1.0", "libcamera", "security")
_PYTHON = ("usr/lib/python3", "usr/lib/python3.*")

_NEEDED = re.compile(r"\(NEEDED\) +Shared library: \[(.*)\]$", re.MULTILINE)


def needed(path: Path) -> tuple[str, ...] | None:
    """The libraries that an ELF file names (DT_NEEDED); None for any other file.

    Raises `DeployError` for an ELF file that is cut.
    """
    with path.open("rb") as file:
        if file.read(4) != b"\x7fELF":
            return None
    said = run(["readelf", "--dynamic", "--wide", path], ok=(0, 1), merge=True)
    if b"readelf: Error: " in said:
        raise DeployError(f"{path}: the ELF file is cut or damaged")
    return tuple(_NEEDED.findall(said.decode(errors="replace")))


def missing(root: Path) -> list[str]:
    """What programs, plugins and modules under `root` want and don't find, as `FILE: LIBRARY`."""
    folders = [folder for folder in root.glob("usr/lib/*-linux-gnu*") if folder.is_dir()]
    libraries: dict[str, Path] = {}
    # Some lie in a folder of their program's own, which it names (RUNPATH): sudo's, systemd's.
    for top in ("usr/lib", "usr/libexec"):
        for path in (root / top).rglob("*.so*"):
            if _resolved(root, path) is not None:
                libraries.setdefault(path.name, path)
    waiting = [(path, path) for path in _first(root, folders)]
    seen: set[Path] = set()
    lacking: set[str] = set()
    while waiting:
        path, first = waiting.pop()
        real = _resolved(root, path)
        if real is None or real in seen:
            continue
        seen.add(real)
        for name in needed(real) or ():
            if name in libraries:
                waiting.append((libraries[name], first))
            elif not name.startswith("ld-linux"):
                lacking.add(f"/{first.relative_to(root)}: {name}")
    return sorted(lacking)


def _first(root: Path, folders: list[Path]) -> Iterator[Path]:
    for name in _PROGRAMS:
        yield from (path for path in (root / name).rglob("*") if path.is_file())
    for folder in folders:
        for name in _LOADED:
            yield from (folder / name).rglob("*.so")
            yield from (p for p in (folder / name).rglob("*") if p.is_file() and not p.suffix)
        yield from folder.glob("libnss_*.so.2")
    for pattern in _PYTHON:
        for folder in root.glob(pattern):
            yield from folder.rglob("*.so")


def _resolved(root: Path, path: Path) -> Path | None:
    """The file behind links, of which absolute ones start at `root`; None where there is none."""
    for _ in range(8):
        if not path.is_symlink():
            return path if path.is_file() else None
        target = path.readlink()
        absolute = target.is_absolute()
        path = root / target.relative_to("/") if absolute else path.parent / target
    return None


def main(arguments: list[str]) -> int:
    """Prints what is missing under the folder; 1 when anything is."""
    lacking = missing(Path(arguments[0]).resolve())
    for line in lacking:
        print(f"E: misses a library: {line}", file=sys.stderr)
    return 1 if lacking else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
