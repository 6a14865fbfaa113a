"""What the root file system holds beside the packages: ours, and who and what runs."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

from deploy.errors import DeployError
from deploy.image import checkout as git
from deploy.image.release import utc
from deploy.image.tree import Tree
from deploy.image.units import DEFAULT_TARGET, apply_presets
from deploy.image.users import Accounts

OURS = "usr/lib/blimp"
RELEASE = f"{OURS}/release"
PROGRAMS = f"{OURS}/deploy"
ACCOUNTS = "usr/lib/sysusers.d/blimp.conf"
CLOCK_EPOCH = "usr/lib/clock-epoch"

# Programs that run on the card, as the package `deploy` of PYTHONPATH=/usr/lib/blimp.
_ON_CARD = ("board", "provisioning")
# Of one machine or one day; keys above all are made on the card.
_NOT_SHIPPED = (
    "etc/ssh/ssh_host_*", "etc/resolv.conf.*", "var/lib/systemd/random-seed", "var/log/*",
    "var/cache/*", "var/lib/apt/*", "tmp/*", "run/*", "dev/*", "proc/*", "sys/*",
)  # fmt: skip
_MODES = {"etc/sudoers.d/blimp": 0o440}


def customise(tree: Tree, checkout: Path, board: str, release: Tree, epoch: int) -> list[str]:
    """Makes a system of packages the payload's; changes the tree in place.

    Args:
        tree: what the packages gave.
        checkout: of this project, with git.
        board: its name, as in `--board`.
        release: the firmware that the card comes with.
        epoch: s since 1970; the clock of a board without one starts here.

    Returns:
        The units that are enabled, sorted.
    """
    for path in [name for name, _ in tree.items() if any(_fits(name, p) for p in _NOT_SHIPPED)]:
        tree.remove(path)
    _programs(tree, checkout)
    for path, entry in release.items():
        tree.add(f"{RELEASE}/{path}", entry)
    static = checkout / "deploy/board/root"
    tree.take(static, git.files(checkout, "deploy/board/root"))
    for path, mode in _MODES.items():
        if path in tree:
            tree.replace(path, mode=mode)
    defaults = checkout / f"deploy/board/payload/{board}.toml"
    tree.take_file(defaults, "usr/share/blimp/payload.toml")
    document = {"board": board, "image": git.version(checkout), "made": utc(epoch)}
    tree.write("usr/share/blimp/board.json", json.dumps(document, indent=2) + "\n")
    for folder in ("data", "boot/firmware", "var/log/journal"):
        if folder not in tree:
            tree.folder(folder)
    accounts = Accounts(tree)
    accounts.remove_people()
    accounts.apply(ACCOUNTS)
    accounts.lock()
    accounts.write()
    if DEFAULT_TARGET not in tree:
        tree.link(DEFAULT_TARGET, "/usr/lib/systemd/system/multi-user.target")
    # Systemd's first clock on a board that has none, by this file's time.
    tree.write(CLOCK_EPOCH, "")
    # As new as /usr: no boot thinks that the system was just updated (systemd-update-done).
    for folder in ("etc", "var"):
        tree.write(f"{folder}/.updated", f"TIMESTAMP_NSEC={epoch}000000000\n")
    return apply_presets(tree)


def add_byte_code(tree: Tree, compile: Callable[[Path, str], None]) -> None:
    """Adds what `compile` puts beside the card's own Python: the root is read-only at boot."""
    with tempfile.TemporaryDirectory(prefix="blimp-bytecode-") as work:
        folder = Path(work)
        for path, entry in tree.below(OURS):
            if entry.kind == "file" and path.endswith(".py"):
                place = folder / path.removeprefix(f"{OURS}/")
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(entry.content.read())
        compile(folder, f"/{OURS}")
        for place in sorted(folder.rglob("*.pyc")):
            tree.write(f"{OURS}/{place.relative_to(folder)}", place.read_bytes())


def _programs(tree: Tree, checkout: Path) -> None:
    files = git.files(checkout, "deploy")
    taken = [
        name
        for name in files
        if name in ("__init__.py", "errors.py", "run.py")
        or (name.startswith(tuple(f"{room}/" for room in _ON_CARD)) and name.endswith(".py"))
    ]
    if not any(name.startswith("board/") for name in taken):
        raise DeployError(f"{checkout}: no deploy/board in git")
    tree.remove(PROGRAMS)
    tree.take(checkout / "deploy", taken, PROGRAMS)


def _fits(path: str, pattern: str) -> bool:
    """Whether the pattern names this path; `*` only at its end, and not below a folder's."""
    stem = pattern.removesuffix("*")
    return path.startswith(stem) and "/" not in path[len(stem) :]
