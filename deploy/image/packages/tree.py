"""Folders that are the same for the same content."""

from __future__ import annotations

import os
from pathlib import Path

# 1980-01-01, the oldest time that a zip file and FAT can tell.
_TIME_S = 315_532_800
_FOLDER_MODE = 0o755


def settle_times(folder: Path) -> None:
    """Gives everything in a folder, itself included, one fixed time, and its folders one mode."""
    for path in (*folder.rglob("*"), folder):
        if path.is_dir() and not path.is_symlink():
            path.chmod(_FOLDER_MODE)
        os.utime(path, (_TIME_S, _TIME_S), follow_symlinks=False)
