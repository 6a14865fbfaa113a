"""Files written beside and renamed, both synced: after a power cut there is the old one or the new.

Without the sync of the file a name may survive that holds nothing, without that of the folder the
old name may (Pillai et al., "All File Systems Are Not Created Equal", OSDI 2014).
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

PART = ".part"
"""What a file is called, after its name, until it is whole."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a name beside `path`; what is written there takes its place when the block ends well.

    Otherwise nothing of it is left. Raises `OSError`, also for what is a device or a pipe: renamed
    over by root, the machine would be without its /dev/full.
    """
    if path.parent == Path("/dev") or (path.exists() and not (path.is_file() or path.is_dir())):
        raise OSError(errno.EINVAL, "a device or a pipe, not a file")
    part = path.with_name(path.name + PART)
    try:
        yield part
        replace(part, path)
    except BaseException:  # and only then: with its name it is another's, who writes next
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def write(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Writes a whole file, new with the permissions `mode` less the umask; raises `OSError`."""
    with replacing(path) as part:
        part.unlink(missing_ok=True)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        with open(descriptor, "wb") as file:
            file.write(data)


def replace(part: Path, path: Path) -> None:
    """Gives a file that is written its name, or a folder with all in it; raises `OSError`."""
    sync_all(part)
    part.replace(path)
    sync(path.parent)


def sync_all(path: Path) -> None:
    """Brings a file, or a folder with all files and folders in it, to the disk."""
    for entry in (*path.rglob("*"), path):
        if not entry.is_symlink() and (entry.is_file() or entry.is_dir()):
            sync(entry)


def sync(path: Path) -> None:
    """Brings a file's bytes or a folder's names to the disk; raises `OSError`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that does not sync such a thing
            raise
    finally:
        os.close(descriptor)
