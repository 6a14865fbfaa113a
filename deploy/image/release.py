"""A release of the firmware out of a checkout: its files, its wheels and `release.json`, as a tree.

The same on every card, whether it came with the image (`/usr/lib/blimp/release`) or by an update:

    pi_firmware/…   as tracked in git
    site/…          wheels, unpacked
    release.json    {"schema": "blimp.release/1", "version", "machine", "python", "made"}
"""

from __future__ import annotations

import json
import tomllib
from datetime import UTC, datetime
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.tree import Tree
from deploy.run import run

# What a card is made of. A change elsewhere (a test, a page) makes no other card.
_INGREDIENTS = ("pi_firmware", "deploy", "pyproject.toml", "requirements.lock")
_REVISION_DIGITS = 12


def files(checkout: Path, folder: str) -> list[str]:
    """The tracked files below a folder, by their names inside it, sorted."""
    listed = _git(checkout, "ls-files", "-z", "--", folder).split("\0")
    return sorted(name.removeprefix(f"{folder}/") for name in listed if name)


def revision(checkout: Path) -> str:
    """The last commit's hash; `-dirty` behind it when an ingredient was changed since."""
    found = _git(checkout, "rev-parse", "HEAD").strip()
    changed = _git(
        checkout, "status", "--porcelain", "--untracked-files=no", "--", *_INGREDIENTS
    ).strip()
    return found + ("-dirty" if changed else "")


def version(checkout: Path) -> str:
    """The project's version and the commit, as `0.1.0+git0123456789ab` or `….dirty`."""
    try:
        project = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]
    except (OSError, KeyError, tomllib.TOMLDecodeError) as error:
        raise DeployError(f"{checkout}/pyproject.toml: no project in it: {error}") from None
    commit, _, dirty = revision(checkout).partition("-")
    return f"{project['version']}+git{commit[:_REVISION_DIGITS]}{'.dirty' if dirty else ''}"


def epoch(checkout: Path, *folders: str) -> int:
    """The time of the last commit (of one that touched these), s since 1970."""
    said = _git(checkout, "log", "-1", "--format=%ct", "--", *folders).strip()
    if not said.isdigit():
        raise DeployError(f"{checkout}: no commit to take the time of: give --epoch")
    return int(said)


def _git(checkout: Path, *words: str) -> str:
    # Whoever builds as root builds from somebody else's checkout, too.
    owned = ["-c", f"safe.directory={checkout.resolve()}"]
    return run(["git", *owned, "-C", checkout, *words]).decode()


SCHEMA = "blimp.release/1"


def build(checkout: Path, site: Path | None, machine: str, python: str, epoch: int) -> Tree:
    """The release of a checkout's tracked files, made at `epoch`, s since 1970.

    `site` is a folder of unpacked wheels that run on the machine (None: none are needed), `machine`
    as `uname -m` says there, `python` as `3.13`.
    """
    tree = Tree()
    firmware = files(checkout, "pi_firmware")
    if "__main__.py" not in firmware:
        raise DeployError(f"{checkout}: no pi_firmware in git")
    tree.take(checkout / "pi_firmware", firmware, "pi_firmware")
    tree.folder("site")
    if site is not None:
        tree.take(site, folder_files(site), "site")
    document = {
        "schema": SCHEMA,
        "version": version(checkout),
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
