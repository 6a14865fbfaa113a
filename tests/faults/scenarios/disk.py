"""A small disk of a test's own, and files that may not grow: what a full card is like."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import resource
import shutil
import subprocess
from pathlib import Path

ERRORS = {"bad": errno.EIO, "read-only": errno.EROFS, "stalls": -1}
"""What `file_fault` is told for a disk that fails without being full."""
KINDS = ("full", *ERRORS)
STALLS = "stalls"
_CLONE_NEWNS = 0x00020000  # sched.h
_BLOCK = bytes(1 << 16)


def alone() -> bool:
    """Gives this process mounts of its own, which end with it; False where that is not allowed."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        return False
    if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNS) != 0:
        return False
    return subprocess.run(["mount", "--make-rprivate", "/"], capture_output=True).returncode == 0


class Disk:
    """A file system in memory at a folder, which can be filled to its last byte."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / "filler"

    def fill(self) -> None:
        """Leaves nothing free."""
        with contextlib.suppress(OSError), self._filler.open("ab", buffering=0) as file:
            while file.write(_BLOCK):
                pass

    def free(self) -> None:
        """Takes back what `fill` took."""
        self._filler.unlink(missing_ok=True)

    def unmount(self, keep: Path) -> None:
        """Takes it away; what was recorded is in `keep` afterwards."""
        self.free()
        shutil.copytree(self.folder, keep, dirs_exist_ok=True)
        subprocess.run(["umount", self.folder], capture_output=True)


def mount(folder: Path, size_MB: int) -> Disk | None:
    """A disk of this size at a folder; None where none can be mounted."""
    folder.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size_MB}m", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode != 0:
        return None
    return Disk(folder)


def limit_files(pid: int, size_bytes: int | None) -> None:
    """No file of a process grows beyond this size from now on; None: as far as it may.

    A write beyond fails (EFBIG), as one does on a full disk.
    """
    try:
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        soft = hard if size_bytes is None else size_bytes
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
    except OSError as error:
        if error.errno not in (errno.ESRCH, errno.EPERM):
            raise


def size_now(folder: Path) -> int:
    """The size of the newest recording in a folder, bytes; 0 without any."""
    newest = max(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns, default=None)
    return newest.stat().st_size if newest is not None else 0
