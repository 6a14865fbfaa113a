"""Which units a system starts: its preset files applied to a tree, as `systemctl preset-all` does.

Done here and not by systemctl, so that a builder needs no systemd and the answer is the same
whatever version of it he has. See systemd.preset(5) and the [Install] section of systemd.unit(5).
"""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, field

from deploy.image.tree import Tree

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
