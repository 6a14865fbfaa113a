"""Puts Wi-Fi, name, keys and settings into a card's boot partition, and reads them back.

What is the same already is left alone, so that a change changes nothing else. `blimp.toml` goes
first and comes last: a card that was left in the middle is not provisioned (two blinks) rather than
provisioned with half of it.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from deploy.board import settings
from deploy.errors import DeployError, Interrupted
from deploy.flash.boot import FOLDER, BootPartition
from deploy.flash.keys import Keys
from deploy.flash.write import Target
from deploy.provisioning.model import Provisioning
from deploy.provisioning.text import parse, render
from deploy.run import run

TOML, PAYLOAD_TOML, CERTIFICATES = (
    f"{FOLDER}/{name}" for name in ("blimp.toml", "payload.toml", "certificates")
)
# A file takes whole clusters, and a folder entry; none of ours is larger.
_CLUSTER_BYTES = 32 * 1024
_CHECK_S = 60.0
_NOT_SET = "the card may lack its settings; set them again"


@dataclass(frozen=True)
class Content:
    """What is to stand in the boot partition; None: what is there stays."""

    provisioning: Provisioning
    keys: Keys | None = None
    payload_toml: bytes | None = None

    @property
    def certificates(self) -> dict[str, bytes] | None:
        """The files of the keys."""
        return self.keys.files if self.keys else None

    def files(self) -> dict[str, bytes]:
        """All of it by path, `blimp.toml` last."""
        files = {f"{CERTIFICATES}/{n}": data for n, data in (self.certificates or {}).items()}
        if self.payload_toml is not None:
            files[PAYLOAD_TOML] = self.payload_toml
        files[TOML] = render(self.provisioning).encode()
        return files


def stored(boot: BootPartition) -> Provisioning | None:
    """What the card's `blimp.toml` says; None when there is none. Raises `DeployError`."""
    return parse(boot.read(TOML)) if boot.has(TOML) else None


def check_room(boot: BootPartition, content: Content) -> None:
    """Raises `DeployError` when it does not fit, before anything is changed."""
    files = content.files()
    needed = sum(-(-len(data) // _CLUSTER_BYTES) + 1 for data in files.values()) * _CLUSTER_BYTES
    free = boot.free_bytes()
    if free < needed:
        raise DeployError(f"{boot.shown}: boot partition: {free} bytes are free; needed: {needed}")


def customise(target: Target, boot: BootPartition, content: Content) -> list[str]:
    """Writes what differs and compares all of it with what reads back; gives what was written.

    Raises `DeployError` with one line; `blimp.toml` is then not there, or not as it was asked for.
    """
    try:
        return _customise(target, boot, content.files(), content.certificates is not None)
    except OSError as error:
        reason = error.strerror or error
        raise DeployError(f"{boot.shown}: write error: {reason}: {_NOT_SET}") from None
    except KeyboardInterrupt:
        raise Interrupted(f"{boot.shown}: interrupted: {_NOT_SET}") from None


def _customise(
    target: Target, boot: BootPartition, files: dict[str, bytes], all_certificates: bool
) -> list[str]:
    present = set(boot.files(FOLDER))
    changed = [p for p, data in files.items() if p not in present or boot.read(p) != data]
    stale = [p for p in present if p.startswith(CERTIFICATES + "/") and p not in files]
    stale = stale if all_certificates else []
    if changed or stale:
        if TOML in present:
            boot.remove(TOML)
            target.flush()
        if TOML not in changed:
            changed.append(TOML)
        for path in stale:
            boot.remove(path)
        if all_certificates and CERTIFICATES not in present:
            boot.make_folder(CERTIFICATES)
        for path in changed:
            if path == TOML:
                target.flush()
            boot.write(path, files[path])
    target.forget()
    for path, data in files.items():
        if boot.read(path) != data:
            raise DeployError(
                f"{boot.shown}: {path} reads back otherwise than it was written: the card or the"
                " reader is bad"
            )
    return changed


def check_payload_toml(
    file: Path, data: bytes, provisioning: Provisioning, certificates: Path | None
) -> None:
    """Lets the firmware check its settings; raises `DeployError` with what it says.

    As a program of its own, with what the card will put over them: the payload's name and, where
    its keys are here, ground station and keys. What it can do there and not here (open a camera, a
    gauge) it does not try; the board's own settings are not looked at.
    """
    document = settings.read(data, str(file))
    if certificates is not None:
        document = settings.merged({}, document, provisioning, str(certificates.absolute()))
    with tempfile.TemporaryDirectory(prefix="blimp-flash-") as folder:
        copy = Path(folder) / "payload.toml"
        copy.write_text(settings.dump(document), encoding="utf-8")
        words = [sys.executable, "-m", "pi_firmware", "--config", str(copy), "--check"]
        words += ["--set", f"payload_id={provisioning.payload_id}"]
        try:
            run(words, cwd=Path(__file__).parents[2], timeout_s=_CHECK_S)
        except DeployError as error:
            said = str(error).removeprefix(f"{Path(words[0]).name}: ")
            said = said.removeprefix("pi_firmware: ").replace(str(copy), str(file))
            raise DeployError(said if str(file) in said else f"{file}: {said}") from None
