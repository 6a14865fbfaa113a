"""Replacing a map's folder as a whole, so that a killed program leaves the old one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ground_station.errors import MapError

_OURS = ("map.toml", "landmarks.safetensors", "keyframes.safetensors", "sparse")


def check_target(folder: Path) -> None:
    """Raises `MapError` unless a map may be written to `folder`.

    It may be new, empty, a map, or hold nothing but plain files under other names than a map's: the
    sample's folder has its recordings beside the map.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise MapError(f"{folder}: is a file, not a folder for a map")
    entries = sorted(folder.iterdir())
    if (folder / "map.toml").is_file() and (folder / "landmarks.safetensors").is_file():
        return
    foreign = [e.name for e in entries if e.name in _OURS or e.is_symlink() or not e.is_file()]
    if foreign:
        raise MapError(
            f"{folder}: is not a map (it holds '{foreign[0]}'); choose a new or empty folder"
        )


@contextmanager
def replacing(folder: Path) -> Iterator[Path]:
    """Gives an empty folder beside `folder`, which takes its place when the block ends well.

    Files in `folder` that are not part of a map (recordings, the floor plan) stay. Raises
    `MapError` as `check_target` does, and when the disk refuses.
    """
    folder = Path(folder).absolute()
    check_target(folder)
    part, old = folder.with_name(folder.name + ".part"), folder.with_name(folder.name + ".old")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        if folder.exists():
            for entry in folder.iterdir():
                if entry.name not in _OURS and not (part / entry.name).exists():
                    _keep(entry, part / entry.name)
            shutil.rmtree(old, ignore_errors=True)
            folder.rename(old)
            try:
                part.rename(folder)
            except OSError:
                old.rename(folder)
                raise
            shutil.rmtree(old, ignore_errors=True)
        else:
            part.rename(folder)
    except OSError as error:
        raise MapError(f"{error.filename or folder}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _keep(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True)
        return
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a file system without hard links
        shutil.copy2(source, target, follow_symlinks=False)
