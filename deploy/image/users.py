"""Users and groups of the card: made from sysusers.d at build time, with no password for anybody.

Made here and not at boot, since the root is read-only and files of the data partition belong to
these numbers. See sysusers.d(5), passwd(5), shadow(5).
"""

from __future__ import annotations

import shlex

from deploy.errors import DeployError
from deploy.image.tree import Tree

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
