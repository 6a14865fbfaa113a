"""Where releases and their state lie, read so that nothing raises and written whole.

Imported at each start of the firmware: nothing heavier than `json` and `typing` here.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from deploy.board.disk import read_bounded

FACTORY = ""
"""The name of the release that came with the image."""

_MOST_BYTES = 4 << 20
_NAME = re.compile(r"[0-9][0-9a-z.+]{0,90}", re.ASCII)


class Places:
    """The paths below `root` ('/' on a card, a folder in tests)."""

    def __init__(self, root: str | Path = "/") -> None:
        root = Path(root)
        self.factory = root / "usr/lib/blimp/release"
        self.board = root / "usr/share/blimp/board.json"
        self.releases = root / "data/releases"
        self.trial = self.releases / "trial.json"
        self.last = self.releases / "last.json"
        self.starts = root / "data/state/starts.json"
        self.frameless = root / "data/state/frameless.json"
        self.running = root / "run/blimp/release.json"
        self.boot_id = root / "proc/sys/kernel/random/boot_id"
        self.uptime = root / "proc/uptime"
        self.signers = root / "data/blimp/certificates/allowed_signers"
        self.config = root / "data/blimp/payload.toml"

    def folder(self, name: str) -> Path:
        """A release's folder; '' is the image's."""
        return self.factory if name == FACTORY else self.releases / name

    def linked(self, link: str) -> str:
        """The name that `current` or `previous` points to, there or not; '' for the image's."""
        try:
            name = str((self.releases / link).readlink())
        except OSError:
            return FACTORY
        return name if is_name(name) else FACTORY

    def point(self, link: str, name: str) -> None:
        """Lets `link` point to a release in one rename; '' takes the link away."""
        path, part = self.releases / link, self.releases / f"{link}.part"
        part.unlink(missing_ok=True)
        if name == FACTORY:
            path.unlink(missing_ok=True)
        else:
            part.symlink_to(name)
            part.replace(path)
        sync_folder(self.releases)

    def this_boot(self) -> str:
        """The kernel's id of this boot; '' when it cannot be read."""
        try:
            return self.boot_id.read_text(encoding="ascii").strip()[:64]
        except (OSError, ValueError):
            return ""

    def uptime_s(self) -> float:
        """Seconds since the board started; 0 when they cannot be read."""
        try:
            return float(self.uptime.read_text(encoding="ascii").split()[0])
        except (OSError, ValueError, IndexError):
            return 0.0


def is_name(name: str) -> bool:
    """Whether a text can be a release's name: a version, and no path."""
    return _NAME.fullmatch(name) is not None and ".." not in name and not name.endswith(".part")


def read(path: Path) -> dict[str, Any] | None:
    """A JSON object from a file; None for anything else, absent or damaged."""
    try:
        data = read_bounded(path, _MOST_BYTES) or b""  # /run/blimp is the firmware's folder
        document = json.loads(data) if len(data) <= _MOST_BYTES else None
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def write(path: Path, document: dict[str, Any], *, durable: bool = True) -> None:
    """Writes JSON beside the file and renames it; raises `OSError`. Durable: it is on the card."""
    part = path.with_name(path.name + ".part")
    data = json.dumps(document, indent=1).encode() + b"\n"
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o644)
    try:
        with open(descriptor, "wb", closefd=False) as file:
            file.write(data)
        if durable:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
    part.replace(path)
    if durable:
        sync_folder(path.parent)


def remove(path: Path) -> None:
    """Takes a file away for good; one that is not there is no fault."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Brings a folder's entries to the card."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
