"""A release of the firmware: its files, its wheels and `release.json`, as a tree.

The same on every card, whether it came with the image (`/usr/lib/blimp/release`) or by an update:

    pi_firmware/…   as tracked in git
    site/…          wheels, unpacked
    release.json    {"schema": "blimp.release/1", "version", "machine", "python", "made"}
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

from deploy.errors import DeployError
from deploy.image import checkout as git
from deploy.image.tree import Tree

SCHEMA = "blimp.release/1"


def build(checkout: Path, site: Path | None, machine: str, python: str, epoch: int) -> Tree:
    """The release of a checkout.

    Args:
        checkout: with git; only tracked files are taken.
        site: a folder of unpacked wheels that run on the machine; None: none are needed.
        machine: as `uname -m` says there.
        python: as `3.13`.
        epoch: when it counts as made, s since 1970.
    """
    tree = Tree()
    firmware = git.files(checkout, "pi_firmware")
    if "__main__.py" not in firmware:
        raise DeployError(f"{checkout}: no pi_firmware in git")
    tree.take(checkout / "pi_firmware", firmware, "pi_firmware")
    tree.folder("site")
    if site is not None:
        tree.take(site, folder_files(site), "site")
    document = {
        "schema": SCHEMA,
        "version": git.version(checkout),
        "machine": machine,
        "python": python,
        "made": utc(epoch),
    }
    tree.write("release.json", json.dumps(document, indent=2) + "\n")
    return tree


def folder_files(folder: Path) -> list[str]:
    """Every file below a folder of generated things, sorted; byte code stays behind."""
    return sorted(
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if not path.is_dir() and "__pycache__" not in path.parts
    )


def utc(epoch: int) -> str:
    """A time as `2026-01-31T12:00:00Z`."""
    return datetime.fromtimestamp(epoch, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
