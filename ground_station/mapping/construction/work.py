"""Folders for long work that outlive a killed build, and go when the work is done."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

_MOST_KEPT = 4
_OLDEST_S = 14 * 24 * 3600.0
"""A build that was not started again for so long, or was followed by others, is given up."""


@contextlib.contextmanager
def lasting(parent: Path, key: str) -> Iterator[Path | None]:
    """The folder `parent/key`, for this process alone: kept when the block fails, else removed.

    It may hold what a block that was ended had left in it. None where another process has it, or
    where the disk refuses. Folders of others that nobody has are pruned.
    """
    folder, handle = parent / key, None
    with contextlib.suppress(OSError):
        _prune(parent, key)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = _hold(folder)
        os.utime(folder)
    if handle is None:
        yield None
        return
    try:
        yield folder
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)


def _hold(folder: Path) -> int | None:
    """A descriptor that locks the folder, which ends with the process; None: another has it."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Whoever held it before may have removed it.
        if os.path.samestat(os.fstat(handle), folder.stat()):
            return handle
    except OSError:
        pass
    os.close(handle)
    return None


def _prune(parent: Path, key: str) -> None:
    if not parent.is_dir():
        return
    others = [path for path in parent.iterdir() if path.name != key and not path.is_symlink()]
    others.sort(key=lambda path: -path.stat().st_mtime)
    for rank, path in enumerate(others):
        old = time.time() - path.stat().st_mtime > _OLDEST_S
        if not path.is_dir() or not (old or rank >= _MOST_KEPT - 1):
            continue
        with contextlib.suppress(OSError):
            handle = _hold(path)
            if handle is not None:
                shutil.rmtree(path, ignore_errors=True)
                os.close(handle)
