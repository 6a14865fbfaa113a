"""Where things lie on a card, and what may be written there."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from deploy.board.disk import Owner
from deploy.errors import DeployError
from deploy.run import run

USER = "blimp"


@dataclass(frozen=True)
class Card:
    """The card's folders below `root` ('/' on a card, a folder in tests)."""

    root: Path = Path("/")

    @property
    def partition(self) -> Path:
        """The boot partition, mounted read-only."""
        return self.root / "boot/firmware"

    @property
    def boot(self) -> Path:
        """What a person sees and edits: blimp.toml, payload.toml, certificates/, STATUS.txt."""
        return self.partition / "blimp"

    @property
    def data(self) -> Path:
        return self.root / "data"

    @property
    def blimp(self) -> Path:
        """The provisioning in force."""
        return self.data / "blimp"

    @property
    def ssh(self) -> Path:
        return self.data / "ssh"

    @property
    def defaults(self) -> Path:
        """The board's own payload.toml."""
        return self.root / "usr/share/blimp/payload.toml"

    @property
    def outcome(self) -> Path:
        """What provisioning came to in this boot."""
        return self.root / "run/blimp-board/provisioning.json"

    @property
    def resolver(self) -> Path:
        """The name servers; /etc/resolv.conf points here."""
        return self.root / "run/blimp-board/resolv.conf"


@contextlib.contextmanager
def writable(card: Card) -> Iterator[None]:
    """The boot partition, writable for as long as this lasts; a folder (in tests) always is.

    Raises `DeployError` when it cannot be made so.
    """
    if not os.path.ismount(card.partition):
        yield
        return
    run(["mount", "-o", "remount,rw", card.partition], timeout_s=30)
    try:
        yield
    finally:
        run(["mount", "-o", "remount,ro", card.partition], timeout_s=60)


class Owners(NamedTuple):
    """Who owns what below /data/blimp: the firmware reads it and changes nothing there."""

    root: Owner = Owner()
    reader: Owner = Owner()

    @classmethod
    def of_system(cls) -> Owners:
        """By the card's own users; raises `DeployError` where there is none of ours."""
        try:
            pwd.getpwnam(USER)
            return cls(Owner(0, 0), Owner(0, grp.getgrnam(USER).gr_gid))
        except KeyError:
            raise DeployError(f"there is no user {USER} on this system") from None
