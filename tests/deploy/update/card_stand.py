"""A card in a folder: the image's release, a trusted key, bundles for it, and who is systemd."""

from __future__ import annotations

import io
import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deploy.board import start
from deploy.board.releases import choose, receive
from deploy.board.releases.choose import Choice
from deploy.board.releases.places import Places
from deploy.board.releases.service import Seen
from deploy.update import bundle as bundles
from deploy.update.bundle import Bundle

CHECKOUT = Path(__file__).resolve().parents[3]
MACHINE, PYTHON = "aarch64", "3.13"
OLD, NOW, NEW = "0.1.0+git0ld", "0.2.0+gitn0w", "0.2.1+gitnew"
MADE = {OLD: "2026-01-01T00:00:00Z", NOW: "2026-02-01T00:00:00Z", NEW: "2026-03-01T00:00:00Z"}


def release_json(version: str, **other: str) -> bytes:
    document = {
        "schema": "blimp.release/1",
        "version": version,
        "machine": MACHINE,
        "python": PYTHON,
        "made": MADE.get(version, MADE[NEW]),
        **other,
    }
    return json.dumps(document).encode()


def contents(
    version: str, more: Mapping[str, bytes] | None = None, **other: str
) -> dict[str, bytes]:
    """A release's files: small, and each release's program another one."""
    return {
        "pi_firmware/__init__.py": f'__version__ = "{version}"\n'.encode(),
        "pi_firmware/__main__.py": f"print({version!r})\n".encode(),
        "site/native.so": bytes(range(256)) * 40,
        "release.json": release_json(version, **other),
        **(more or {}),
    }


def make_key(folder: Path) -> Path:
    """A release key as `blimp keys` makes it."""
    folder.mkdir(parents=True, exist_ok=True)
    key = folder / "1"
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", str(key)]
    subprocess.run(command, check=True, timeout=30)
    return key


class Card:
    """A card's root file system with the image's release NOW; `service` is its systemd."""

    def __init__(self, root: Path, key: Path) -> None:
        self.root, self.key = root, key
        self.at = Places(root)
        self.service = Service()
        for folder in ("data/releases", "data/state", "run/blimp", "data/blimp/certificates"):
            (root / folder).mkdir(parents=True)
        (root / "proc/sys/kernel/random").mkdir(parents=True)
        (root / "proc/uptime").symlink_to("/proc/uptime")
        self.boot("boot-1")
        lay(self.at.factory, contents(NOW))
        lay(self.at.board.parent, {"board.json": b'{"board": "zero2w"}'})
        public = key.with_suffix(".pub").read_text()
        self.at.signers.write_text(f'blimp-release namespaces="blimp-release" {public}')

    def boot(self, boot_id: str) -> None:
        self.at.boot_id.write_text(boot_id + "\n")

    def bundle(self, files: Mapping[str, bytes], replaces: str = "") -> bytes:
        return tar_of(bundles.make(files, self.key, replaces))

    def take(self, data: bytes) -> dict[str, Any]:
        return receive.receive(self.at, io.BytesIO(data), self.service)  # type: ignore[arg-type]

    def choice(self) -> Choice:
        """What the next start would start; counts it, as a start does."""
        return start.choice(self.at, choose.read_state(self.at))

    def start(self) -> Choice:
        """A start as systemd does it, as far as others see it."""
        state = choose.read_state(self.at)
        chosen = start.choice(self.at, state)
        trial = state.trial["id"] if state.on_trial and state.trial else ""
        running = {"name": chosen.name, "trial": trial, "reason": chosen.reason}
        self.at.running.write_text(json.dumps(running))
        return chosen

    def names(self) -> set[str]:
        """What lies in the folder of releases."""
        return {path.name for path in self.at.releases.iterdir()} - {".lock", "last.json"}


class Service:
    """Who is systemd: starts a program when asked; what is seen of it is set by the test."""

    def __init__(self) -> None:
        self.restarts = self.watched = 0
        self.now = Seen(active=True, active_s=60.0, telemetry=False, said="active")
        self.on_restart: Any = lambda: None

    def restart(self) -> None:
        self.restarts += 1
        self.on_restart()

    def watch(self) -> None:
        self.watched += 1

    def seen(self) -> Seen:
        return self.now


def tar_of(bundle: Bundle, held: Mapping[str, str] | None = None) -> bytes:
    out = io.BytesIO()
    bundles.write(bundle, out, held)
    return out.getvalue()


def lay(folder: Path, files: Mapping[str, bytes]) -> None:
    for path, data in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
