"""Replacing a map's folder as a whole, so that a killed program leaves the old one."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import hashlib
import itertools
import os
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

from ground_station.errors import MapError, MapInUseError
from pi_firmware.wire import files

FLOORPLAN = ("floorplan.png", "floorplan.yaml")
FLOWN_IN = ("map.toml", "landmarks.safetensors", "keyframes.safetensors", *FLOORPLAN)
"""What is needed to localize in a map and to show it."""
_OURS = ("map.toml", "landmarks.safetensors", "keyframes.safetensors", "sparse")
PICTURE = "map.png"
"""What a build draws of its map; it is not kept where another map takes the place."""


PARTS = {
    "landmarks": ("landmarks.safetensors",),
    "keyframes": ("keyframes.safetensors",),
    "sparse": ("sparse",),
    "other": ("map.toml", *FLOORPLAN),
}
"""What a map's folder holds of it, by part. Recordings that lie beside it are not of it."""


def files_flown_in(folder: Path) -> list[Path]:
    """The files of a map that localizers and pages read."""
    return [folder / name for name in FLOWN_IN if (folder / name).is_file()]


def sizes(folder: str | Path) -> dict[str, int]:
    """The bytes of each part and in all (`total`) of a map on disk."""
    whole = Path(folder)
    found = {part: sum(_bytes(whole / name) for name in names) for part, names in PARTS.items()}
    return found | {"total": sum(found.values())}


def _bytes(path: Path) -> int:
    if path.is_dir():
        return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())
    return path.stat().st_size if path.is_file() else 0


def content_id(folder: Path) -> str:
    """Tells a map from another of the same name: its files' names and sizes, its `map.toml`."""
    found = hashlib.sha256()
    with contextlib.suppress(OSError):
        for path in files_flown_in(folder):
            found.update(f"{path.name} {path.stat().st_size}\n".encode())
        found.update((folder / "map.toml").read_bytes())
    return found.hexdigest()[:16]


def check_is_map(folder: Path) -> None:
    """Raises `MapError`, with the command that makes one, unless a map lies in the folder."""
    if (folder / "map.toml").exists():
        return
    if folder.is_file():
        made = f"blimp map build {shlex.quote(str(folder))} --out maps/NAME"
        raise MapError(f"{folder}: is a file, not a map's folder; {made} makes a map of a video")
    what = "a folder without a map (map.toml)" if folder.is_dir() else "there is no such map"
    made = f"blimp map build INPUT --out {shlex.quote(str(folder))}"
    raise MapError(f"{folder}: {what}; {made} makes one")


def check_target(folder: Path) -> None:
    """Raises `MapError` unless a map may be written to `folder`.

    It may be new, empty, a map, or hold nothing but plain files under other names than a map's: the
    sample's folder has its recordings beside the map.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise MapError(
            f"{folder}: is a file, not a folder for a map; name a new one, as --out maps/NAME"
        )
    entries = sorted(folder.iterdir())
    if (folder / "map.toml").is_file() and (folder / "landmarks.safetensors").is_file():
        return
    foreign = [e.name for e in entries if e.name in _OURS or e.is_symlink() or not e.is_file()]
    if foreign:
        raise MapError(
            f"{folder}: is not a map (it holds '{foreign[0]}'); choose a new or empty folder"
        )


def kept_name(folder: Path) -> Path:
    """The first free name for a map that is replaced and kept: NAME.before, NAME.before-2, …"""
    names = (f"{folder.name}.before" + (f"-{n}" if n > 1 else "") for n in itertools.count(1))
    return next(path for path in map(folder.with_name, names) if not os.path.lexists(path))


def carry_floorplan(source: Path, target: Path) -> None:
    """Copies a map's floor plan, where it has one, into the folder of a map made from it."""
    for name in FLOORPLAN:
        if (source / name).is_file():
            shutil.copy2(source / name, target / name)


@contextlib.contextmanager
def replacing(folder: Path, keep: Path | None = None) -> Iterator[Path]:
    """Gives an empty folder beside `folder`, which takes its place when the block ends well.

    Files in `folder` that are not part of a map (recordings, the floor plan) stay. What was there
    is kept as `keep`, a free name beside it, where given. Where the system can, the two change
    places at once, so that a program killed at any moment leaves a whole map. Raises `MapError` as
    `check_target` does, while another program writes this map, and when the disk refuses.
    """
    folder = Path(folder).absolute()
    check_target(folder)
    part = folder.with_name(folder.name + ".part")
    old = keep.absolute() if keep is not None else folder.with_name(folder.name + ".old")
    try:
        with _alone(part, folder):
            yield part
            files.sync_all(part)
            if folder.exists():
                for entry in folder.iterdir():
                    if entry.name not in (*_OURS, PICTURE) and not (part / entry.name).exists():
                        _keep(entry, part / entry.name)
                files.sync(part)
                if keep is None:
                    shutil.rmtree(old, ignore_errors=True)
                _swap(part, folder, old)
                if keep is None:
                    shutil.rmtree(old, ignore_errors=True)
            else:
                part.rename(folder)
            files.sync(folder.parent)
    except OSError as error:
        raise MapError(f"{error.filename or folder}: {error.strerror or error}") from None


@contextlib.contextmanager
def _alone(part: Path, folder: Path) -> Iterator[None]:
    """Keeps other programs out of `part`, which is empty then, and gone afterwards."""
    part.mkdir(parents=True, exist_ok=True)
    lock = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise MapInUseError(
                f"{folder}: another command is writing this map: wait for it, or choose another"
                " folder"
            ) from None
        for entry in part.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        try:
            yield
        finally:
            shutil.rmtree(part, ignore_errors=True)
    finally:
        os.close(lock)


def _swap(part: Path, folder: Path, old: Path) -> None:
    """Puts `part` in the place of `folder`, which becomes `old`, a name that is free."""
    part.rename(old)
    if _exchange(old, folder):
        return
    old.rename(part)
    folder.rename(old)
    try:
        part.rename(folder)
    except BaseException:  # Ctrl-C between the two, too
        old.rename(folder)
        raise


def _exchange(one: Path, other: Path) -> bool:
    """Lets two names change places at once, by Linux's renameat2; False where that is unknown."""
    here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of linux/fs.h
    try:
        rename = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError):
        return False
    return bool(rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0)


def _keep(source: Path, target: Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a folder, or a file system without hard links
        if source.is_dir() and not source.is_symlink():
            shutil.copytree(source, target, symlinks=True)
        else:
            shutil.copy2(source, target, follow_symlinks=False)
        files.sync_all(target)
