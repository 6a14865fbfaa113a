"""Small files, most of them the kernel's, read so that nothing raises and nothing waits."""

from __future__ import annotations

import os
import re

_LIMIT_BYTES = 4096
_NUMBER = re.compile(r"-?[0-9]{1,15}", re.ASCII)


def text(path: str | os.PathLike[str]) -> str | None:
    """The first 4096 characters of a file; None when it is absent, unreadable or not ASCII.

    A FIFO or device that has nothing to say is not waited for.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            return os.read(descriptor, _LIMIT_BYTES).decode("ascii")
        finally:
            os.close(descriptor)
    except (OSError, ValueError):
        return None


def number(path: str | os.PathLike[str]) -> int | None:
    """The one whole number of 15 digits at most that a file holds; None for anything else."""
    found = (text(path) or "").strip()
    return int(found) if _NUMBER.fullmatch(found) else None
