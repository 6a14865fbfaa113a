"""What the root file system holds beside the packages: ours, and who and what runs.

Units are enabled as `systemctl preset-all` does and accounts made as `systemd-sysusers` does, here
and by neither of them, so that a builder needs no systemd and the answer is the same whatever
version of it he has; and not at boot, since the root is read-only and files of the data partition
belong to these numbers. See systemd.preset(5), the [Install] section of systemd.unit(5),
sysusers.d(5), passwd(5), shadow(5).
"""

from __future__ import annotations

import fnmatch
import json
import shlex
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deploy.errors import DeployError
from deploy.image.release import files, utc, version
from deploy.image.tree import Tree

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
    """Makes a system of packages the payload's, in place; gives the units that are enabled, sorted.

    `release` is the firmware that the card comes with; at `epoch`, s since 1970, the clock of a
    board without one starts.
    """
    for path in [name for name, _ in tree.items() if any(_fits(name, p) for p in _NOT_SHIPPED)]:
        tree.remove(path)
    _programs(tree, checkout)
    for path, entry in release.items():
        tree.add(f"{RELEASE}/{path}", entry)
    static = checkout / "deploy/board/root"
    tree.take(static, files(checkout, "deploy/board/root"))
    for path, mode in _MODES.items():
        if path in tree:
            tree.replace(path, mode=mode)
    defaults = checkout / f"deploy/board/payload/{board}.toml"
    tree.take_file(defaults, "usr/share/blimp/payload.toml")
    document = {"board": board, "image": version(checkout), "made": utc(epoch)}
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
    tracked = files(checkout, "deploy")
    taken = [
        name
        for name in tracked
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


UNITS = "usr/lib/systemd/system"
ENABLED = "etc/systemd/system"
DEFAULT_TARGET = f"{ENABLED}/default.target"
_PRESETS = ("etc/systemd/system-preset", "usr/lib/systemd/system-preset")
_SUFFIXES = (".service", ".socket", ".target", ".path", ".timer", ".mount", ".automount", ".swap")
_FOLDERS = {"WantedBy": "wants", "RequiredBy": "requires", "UpheldBy": "upholds"}


@dataclass
class Install:
    """A unit's [Install] section."""

    wanted_by: list[tuple[str, str]] = field(default_factory=list)  # (folder's suffix, unit)
    aliases: list[str] = field(default_factory=list)
    also: list[str] = field(default_factory=list)
    instance: str = ""


def apply_presets(tree: Tree) -> list[str]:
    """Enables and disables every unit as the first preset line that fits it says.

    Masked units (links to /dev/null) and the default target stay.

    Returns:
        The enabled units, sorted.
    """
    rules = _rules(tree)
    masked = {path for path, entry in tree.below(ENABLED) if entry.target == "/dev/null"}
    for path, entry in list(tree.below(ENABLED)):
        if entry.kind == "link" and path not in masked and path != DEFAULT_TARGET:
            tree.remove(path)
    installs = {
        name: install
        for name in _units(tree)
        if f"{ENABLED}/{name}" not in masked and (install := _read(tree, name)) is not None
    }
    enabled: set[str] = set()
    todo = [name for name in installs if _is_enabled(name, rules)]
    while todo:
        name = todo.pop()
        if name not in enabled and name in installs:
            enabled.add(name)
            todo += installs[name].also
    for name in sorted(enabled):
        _enable(tree, name, installs[name])
    return sorted(enabled)


def _rules(tree: Tree) -> list[tuple[str, str]]:
    """(verb, pattern) in the order of the files' names; /etc's file hides another of that name."""
    files: dict[str, str] = {}
    for folder in _PRESETS:
        for path, entry in tree.below(folder):
            if path.endswith(".preset") and entry.kind != "folder":
                files.setdefault(path.rpartition("/")[2], path)
    rules = []
    for name in sorted(files):
        for line in tree.read(files[name]).decode().splitlines():
            words = line.split("#")[0].split()
            if len(words) >= 2 and words[0] in ("enable", "disable", "ignore"):
                rules.append((words[0], words[1]))
    return rules


def _is_enabled(name: str, rules: list[tuple[str, str]]) -> bool:
    for verb, pattern in rules:
        if fnmatch.fnmatchcase(name, pattern):
            return verb == "enable"
    return True


def _units(tree: Tree) -> list[str]:
    names = {
        path.rpartition("/")[2]
        for folder in (UNITS, ENABLED)
        for path, entry in tree.below(folder)
        if entry.kind == "file" and path.count("/") == folder.count("/") + 1
    }
    return sorted(name for name in names if name.endswith(_SUFFIXES))


def _read(tree: Tree, name: str) -> Install | None:
    """The unit's [Install]; None without one: then something else starts it, or nothing."""
    folder = ENABLED if f"{ENABLED}/{name}" in tree else UNITS
    result: Install | None = None
    section = ""
    text = tree.read(f"{folder}/{name}").decode("utf-8", "replace").replace("\\\n", " ")
    for line in (raw.strip() for raw in text.splitlines()):
        if line.startswith("["):
            section = line
            if section == "[Install]":
                result = result or Install()
        elif section == "[Install]" and result is not None and line[:1] not in ("#", ";", ""):
            key, _, value = line.partition("=")
            words = value.split()
            if key in _FOLDERS:
                result.wanted_by += [(_FOLDERS[key], word) for word in words]
            elif key == "Alias":
                result.aliases += words
            elif key == "Also":
                result.also += words
            elif key == "DefaultInstance":
                result.instance = value.strip()
    return result


def _enable(tree: Tree, name: str, install: Install) -> None:
    folder = ENABLED if f"{ENABLED}/{name}" in tree else UNITS
    target = f"/{folder}/{name}"
    prefix, _, suffix = name.partition("@")
    linked = f"{prefix}@{install.instance}{suffix}" if "@" in name else name
    if "@" in name and not install.instance:
        return  # a template alone starts nothing
    for kind, wanting in install.wanted_by:
        tree.link(f"{ENABLED}/{wanting}.{kind}/{linked}", target)
    for alias in install.aliases:
        if f"{ENABLED}/{alias}" not in tree:
            tree.link(f"{ENABLED}/{alias}", target)


# No password fits "*", and unlike "!" sshd does not take it for a locked account: keys work.
NO_PASSWORD = "*"
# Debian's range of users that are persons (adduser.conf's FIRST_UID and LAST_UID).
_PEOPLE = range(1000, 60000)
_FILES = ("passwd", "group", "shadow", "gshadow")


class Accounts:
    """The four files of accounts of a tree."""

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._rows = {
            name: [line.split(":") for line in _text(tree, name).splitlines() if line]
            for name in _FILES
        }

    def remove_people(self) -> None:
        """Takes away who is no part of the system: a base image's own user, and his group."""
        for file in ("passwd", "group"):
            for row in [row for row in self._rows[file] if int(row[2]) in _PEOPLE]:
                self._rows[file].remove(row)
                shadow = "shadow" if file == "passwd" else "gshadow"
                self._rows[shadow] = [kept for kept in self._rows[shadow] if kept[0] != row[0]]

    def apply(self, path: str) -> None:
        """Makes what a sysusers.d file of the tree names and the tree does not have yet.

        Raises:
            DeployError: a line that is not understood, or a number that another has.
        """
        for number, line in enumerate(self._tree.read(path).decode().splitlines(), start=1):
            words = shlex.split(line, comments=True)
            if not words:
                continue
            words += ["-"] * (6 - len(words))
            kind, name, identifier = words[0].rstrip("!"), words[1], words[2]
            if kind == "g":
                self._group(name, identifier)
            elif kind == "u":
                self._user(name, identifier, *words[3:6])
            elif kind == "m":
                self._member(name, identifier)
            else:
                raise DeployError(f"/{path}:{number}: '{line}': not understood")

    def lock(self) -> None:
        """Takes every password away, and every account's that has an empty one."""
        for row in self._rows["passwd"]:
            row[1] = "x"
        known = {row[0] for row in self._rows["shadow"]}
        for row in self._rows["passwd"]:
            if row[0] not in known:
                # The day of the last change is empty: no ageing, and no day of building.
                self._rows["shadow"].append([row[0], NO_PASSWORD, "", "0", "99999", "7", *[""] * 3])
        for row in self._rows["shadow"]:
            row[1] = NO_PASSWORD
            row[2] = ""
        for row in self._rows["gshadow"]:
            row[1] = "!"

    def write(self) -> None:
        """Writes the four files, with the modes that Debian gives them; leaves no older copy."""
        shadow = next((int(row[2]) for row in self._rows["group"] if row[0] == "shadow"), 0)
        for name, rows in self._rows.items():
            text = "".join(":".join(row) + "\n" for row in rows)
            secret = name.endswith("shadow")
            self._tree.write(f"etc/{name}", text, 0o640 if secret else 0o644, 0, shadow * secret)
            self._tree.remove(f"etc/{name}-")

    def _group(self, name: str, number: str) -> None:
        if not any(row[0] == name for row in self._rows["group"]):
            self._unused("group", name, number)
            self._rows["group"].append([name, "x", number, ""])
            self._rows["gshadow"].append([name, "!", "", ""])

    def _user(self, name: str, number: str, comment: str, home: str, shell: str) -> None:
        if any(row[0] == name for row in self._rows["passwd"]):
            return
        self._unused("passwd", name, number)
        self._group(name, number)
        home = "/" if home == "-" else home
        shell = "/usr/sbin/nologin" if shell == "-" else shell
        about = "" if comment == "-" else comment
        self._rows["passwd"].append([name, "x", number, number, about, home, shell])

    def _member(self, user: str, group: str) -> None:
        for file in ("group", "gshadow"):
            for row in self._rows[file]:
                members = [name for name in row[3].split(",") if name]
                if row[0] == group and user not in members:
                    row[3] = ",".join([*members, user])
        if not any(row[0] == group for row in self._rows["group"]):
            raise DeployError(f"/etc/group: no group '{group}' for {user}")

    def _unused(self, file: str, name: str, number: str) -> None:
        if not number.isdigit():
            raise DeployError(f"{name}: '{number}' is no fixed number")
        for row in self._rows[file]:
            if row[2] == number:
                raise DeployError(f"/etc/{file}: {number} is {row[0]}'s, {name} wants it")


def _text(tree: Tree, name: str) -> str:
    path = f"etc/{name}"
    return tree.read(path).decode() if path in tree else ""
