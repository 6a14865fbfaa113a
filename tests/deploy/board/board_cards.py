"""A card as folders: boot and data partition below one root, and a person's files on the first."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from deploy.board.candidate import Check
from deploy.board.card import Card, Owners
from deploy.board.disk import Disk
from deploy.board.provision import Outcome, provision
from deploy.provisioning.model import Provisioning, Wifi
from deploy.provisioning.text import render

PASSWORD = "kept out of sight"
KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f someone"
WIFI = Wifi(ssid=b"hall", country="DE", password=PASSWORD)
BLIMP = Provisioning("blimp-1", WIFI, authorized_keys=(KEY,))


class Cut(BaseException):
    """Power goes."""


class FastDisk(Disk):
    """A disk that is not waited for."""

    def _sync(self, descriptor: int) -> None:
        pass

    def _sync_folder(self, folder: Path) -> None:
        pass


class CutDisk(FastDisk):
    """A disk whose power goes before the change of that number; counts them otherwise."""

    def __init__(self, last: int | None = None) -> None:
        self.steps, self._last = 0, last

    def _step(self) -> None:
        if self.steps == self._last:
            raise Cut
        self.steps += 1


def certificates(payload_id: str = "blimp-1", mark: str = "1") -> dict[str, bytes]:
    """Files as `blimp keys payload` writes them, as far as the card looks into them."""
    access = {"schema": "blimp.access/1", "name": f"payload.{payload_id}", "peers": ["ground.desk"]}
    return {
        "ca.pem": f"authority {mark}\n".encode(),
        "certificate.pem": f"certificate {mark}\n".encode(),
        "key.pem": f"a private key {mark}\n".encode(),
        "access.json": json.dumps(access).encode(),
        "srtp.key": b"00" * 30,
        "ssh_ed25519": f"a private SSH key {mark}\n".encode(),
        "ssh_ed25519.pub": f"a public SSH key {mark}\n".encode(),
    }


class Person:
    """Who puts files onto the boot partition, and the card that reads them."""

    def __init__(self, root: Path) -> None:
        self.card = Card(root)
        self.card.boot.mkdir(parents=True)
        self.card.data.mkdir()
        self.card.defaults.parent.mkdir(parents=True)
        self.card.defaults.write_text('[camera]\nuri = "libcamera:"\nrate_hz = 20.0\n')
        self.checked: list[str] = []

    def gives(
        self,
        what: Provisioning | bytes = BLIMP,
        keys: dict[str, bytes] | None = None,
        settings: str | None = None,
    ) -> None:
        text = what if isinstance(what, bytes) else render(what).encode()
        (self.card.boot / "blimp.toml").write_bytes(text)
        for name, data in (keys or {}).items():
            (self.card.boot / "certificates").mkdir(exist_ok=True)
            (self.card.boot / "certificates" / name).write_bytes(data)
        if settings is not None:
            (self.card.boot / "payload.toml").write_text(settings)

    def boots(self, disk: Disk | None = None, check: Check | None = None) -> Outcome:
        return provision(self.card, disk or FastDisk(), Owners(), check or self.check)

    def check(self, folder: Path) -> None:
        self.checked.append((folder / "payload.toml").read_text())

    def state(self) -> dict[str, bytes]:
        """Every file of both partitions with its content and mode, and every folder."""
        found = {}
        for top in (self.card.boot, self.card.data):
            for path in sorted(top.rglob("*")):
                name = f"{path.relative_to(self.card.root)} {path.stat().st_mode & 0o777:o}"
                found[name] = path.read_bytes() if path.is_file() else b""
        return found

    def holds_secret(self) -> bool:
        """Whether the boot partition still has any."""
        everything = b"".join(p.read_bytes() for p in self.card.boot.rglob("*") if p.is_file())
        return PASSWORD.encode() in everything or b"private" in everything


def renamed(ssid: str, password: str = "") -> Provisioning:
    """The same payload in another network."""
    return dataclasses.replace(BLIMP, wifi=Wifi(ssid.encode(), "DE", password))
