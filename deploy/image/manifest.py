"""What an image was made of and what it is: the JSON file beside it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.image import checkout as git
from deploy.image.partitions import table
from deploy.image.release import folder_files, utc
from deploy.image.sparse import Range, sha256
from deploy.image.tree import Tree
from deploy.run import run

SCHEMA = "blimp.image/1"
_PARTITIONS = ("boot", "root", "data")
_NUMBER = re.compile(r"\d\.\d")

# The tools whose work is in the bytes, and how each says its version.
_TOOLS = {
    "debugfs": ["debugfs", "-V"],
    "mcopy": ["mcopy", "--version"],
    "mke2fs": ["mke2fs", "-V"],
    # mkfs.vfat says its version only at work; its sister of the same package always.
    "mkfs.vfat": ["fsck.vfat", "-n", "/dev/null"],
    "sfdisk": ["sfdisk", "--version"],
}


@dataclass(frozen=True)
class Told:
    """What an image does not tell by itself.

    Attributes:
        board, checkout, epoch: what it was made for, of and at.
        packages: name, version, architecture of what is installed.
        site: the unpacked wheels.
        units: that are enabled.
        base: the image that it was made from, if any.
    """

    board: str
    checkout: Path
    epoch: int
    packages: Sequence[tuple[str, str, str]]
    site: Path | None
    units: Sequence[str]
    base: Path | None = None


def write(image: Path, to: Path, digest: str, told: Told) -> None:
    """Writes the manifest of a finished image, whose SHA-256 in hex is `digest`."""
    partitions = []
    for name, part in zip(_PARTITIONS, table(image), strict=True):
        span = Range(part["start"], part["start"] + part["size"])
        partitions.append({"name": name, **part, "sha256": sha256(image, span)})
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "board": told.board,
        "version": git.version(told.checkout),
        "revision": git.revision(told.checkout),
        "epoch": told.epoch,
        "made": utc(told.epoch),
        "image": {"size": image.stat().st_size, "sha256": digest},
        "partitions": partitions,
        "units": list(told.units),
        "packages": [
            {"name": name, "version": version, "architecture": architecture}
            for name, version, architecture in told.packages
        ],
        "wheels": wheels(told.site),
        "wheels_sha256": _all_files(told.site),
        "tools": {name: _version(words) for name, words in _TOOLS.items()},
    }
    if told.base is not None:
        document["base"] = {"name": told.base.name, "sha256": sha256(told.base)}
    to.write_text(json.dumps(document, indent=2) + "\n")


def packages_of(tree: Tree) -> list[tuple[str, str, str]]:
    """Name, version and architecture of what dpkg calls installed in a tree, if it was there."""
    path = "var/lib/dpkg/status"
    status = tree.read(path).decode("utf-8", "replace") if path in tree else ""
    found = []
    for stanza in status.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in stanza.splitlines() if ": " in line[1:])
        if fields.get("Status", "").endswith(" installed"):
            found.append((fields["Package"], fields["Version"], fields["Architecture"]))
    return sorted(found)


def wheels(site: Path | None) -> list[dict[str, str]]:
    """Name, version and the hash of its list of files (RECORD) of each unpacked wheel."""
    result = []
    for info in sorted(site.glob("*.dist-info")) if site is not None else ():
        name, _, version = info.name.removesuffix(".dist-info").rpartition("-")
        record = info / "RECORD"
        digest = sha256(record) if record.is_file() else ""
        result.append({"name": name, "version": version, "record_sha256": digest})
    return result


def _all_files(site: Path | None) -> str:
    """One hash over all files of the wheels, as of what `sha256sum` prints for them."""
    whole = hashlib.sha256()
    if site is not None:
        for path in folder_files(site):
            whole.update(f"{sha256(site / path)}  {path}\n".encode())
    return whole.hexdigest()


def _version(words: list[str]) -> str:
    said = run(words, merge=True, ok=(0, 1)).decode(errors="replace")
    return next((line.strip() for line in said.splitlines() if _NUMBER.search(line)), "")
