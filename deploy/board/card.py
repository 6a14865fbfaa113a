"""Where things lie on a card, and what may be written there."""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from deploy.board.disk import Owner
from deploy.errors import DeployError
from deploy.run import run

USER = "blimp"


class Card:
    """The card's folders below `root` ('/' on a card, a folder in tests)."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root
        self.partition = root / "boot/firmware"
        """The boot partition, mounted read-only."""
        self.boot = self.partition / "blimp"
        """What a person sees and edits: blimp.toml, payload.toml, certificates/, STATUS.txt."""
        self.data = root / "data"
        self.blimp = self.data / "blimp"
        """The provisioning in force."""
        self.ssh = self.data / "ssh"
        self.defaults = root / "usr/share/blimp/payload.toml"
        """The board's own."""
        self.outcome = root / "run/blimp-board/provisioning.json"
        """What provisioning came to in this boot."""
        self.resolver = root / "run/blimp-board/resolv.conf"
        """The name servers; /etc/resolv.conf points here."""


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
