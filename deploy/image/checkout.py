"""What git knows of a checkout: its files, its version, the time of its last commit."""

from __future__ import annotations

import tomllib
from pathlib import Path

from deploy.errors import DeployError
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
