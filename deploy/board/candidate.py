"""The folder /data/blimp, built beside it from what the boot partition says and checked whole."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from deploy.board import settings
from deploy.board.card import Card, Owners
from deploy.board.disk import Disk, read_bounded
from deploy.board.inputs import (
    CERTIFICATES,
    FILE,
    HOST_KEY,
    HOST_KEY_PUBLIC,
    KNOWN,
    MOST_BYTES,
    MOST_CERTIFICATE_BYTES,
    NEEDED,
    SETTINGS,
    Inputs,
    digest,
)
from deploy.board.releases import places
from deploy.errors import DeployError
from deploy.provisioning.model import Provisioning, without_secrets
from deploy.provisioning.text import parse, render
from deploy.provisioning.wpa import wpa_supplicant_conf
from deploy.run import run

SCHEMA = "blimp.provisioned/1"
RECORD, RADIO, SSH, KEYS = "provisioned.json", "wpa_supplicant.conf", "ssh", "authorized_keys"
CHECK_LIMIT_S = 240.0

Check = Callable[[Path], None]
"""Looks at a candidate's payload.toml and certificates/; raises `DeployError` with the reason."""


@dataclass(frozen=True)
class Record:
    """provisioned.json: what was taken, by SHA-256; written last, so that it proves the rest.

    `kept` is of blimp.toml without its password, `settings` of the user's payload.toml (empty:
    none), `defaults` of the board's.
    """

    payload_id: str
    toml: str
    kept: str
    settings: str
    defaults: str

    @classmethod
    def read(cls, folder: Path) -> Record | None:
        """That of a folder; None when it is not there or not whole."""
        document = places.read(folder / RECORD) or {}
        if document.pop("schema", None) != SCHEMA:
            return None
        try:
            record = cls(**document)
        except TypeError:
            return None
        return record if all(isinstance(text, str) for text in asdict(record).values()) else None


def held_certificates(folder: Path) -> dict[str, bytes]:
    """The certificates of a provisioning, with its SSH host key, by their names."""
    found = {}
    for name in KNOWN:
        room = SSH if name in (HOST_KEY, HOST_KEY_PUBLIC) else CERTIFICATES
        data = read_bounded(folder / room / name, MOST_CERTIFICATE_BYTES)
        if data is not None:
            found[name] = data
    return found


def kept_toml(toml: bytes, provisioning: Provisioning) -> bytes:
    """blimp.toml without its password; as it is when it holds none."""
    if provisioning.wifi is None or not provisioning.wifi.password:
        return toml
    text = render(without_secrets(provisioning)).encode()
    return text.replace(b"\n", b"\r\n") if b"\r\n" in toml else text


def build(
    card: Card, disk: Disk, owners: Owners, inputs: Inputs, check: Check, folder: Path
) -> tuple[Record, bytes]:
    """Writes the candidate into `folder`; returns its record and blimp.toml without a password.

    What the boot partition leaves out (password, certificates) is taken over from the provisioning
    in force. Raises `DeployError` with one line when anything is wrong with it; the folder is then
    worth nothing.
    """
    provisioning = parse(inputs.toml)
    stored = read_bounded(card.blimp / RADIO, MOST_BYTES) or b""
    try:
        radio = wpa_supplicant_conf(provisioning, stored.decode("ascii", "replace"))
    except DeployError as error:
        raise DeployError(f"{FILE}: {error}") from None
    certificates = inputs.certificates or held_certificates(card.blimp)
    _check_certificates(certificates, provisioning.payload_id)
    defaults = read_bounded(card.defaults, MOST_BYTES) or b""
    document = settings.merged(
        settings.read(defaults, str(card.defaults)),
        settings.read(inputs.settings or b"", SETTINGS),
        provisioning,
        str(card.blimp / CERTIFICATES),
    )
    text = settings.dump(document).encode()
    kept = kept_toml(inputs.toml, provisioning)

    disk.remove(folder)
    disk.make_folder(folder, 0o750, owners.reader)
    _write_keys(folder, disk, owners, certificates, provisioning.authorized_keys)
    if radio:
        disk.write(folder / RADIO, radio.encode(), 0o600, owners.root)
    disk.write(folder / SETTINGS, text, 0o640, owners.reader)
    check(folder)
    record = Record(
        payload_id=provisioning.payload_id,
        toml=digest(inputs.toml),
        kept=digest(kept),
        settings="" if inputs.settings is None else digest(inputs.settings),
        defaults=digest(defaults),
    )
    told = json.dumps({"schema": SCHEMA, **asdict(record)}, indent=1) + "\n"
    disk.write(folder / RECORD, told.encode(), 0o600, owners.root)
    return record, kept


def _write_keys(
    folder: Path,
    disk: Disk,
    owners: Owners,
    certificates: dict[str, bytes],
    authorized: tuple[str, ...],
) -> None:
    disk.make_folder(folder / CERTIFICATES, 0o750, owners.reader)
    disk.make_folder(folder / SSH, 0o700, owners.root)
    for name, data in certificates.items():
        room, owner, mode = (CERTIFICATES, owners.reader, 0o640)
        if name in (HOST_KEY, HOST_KEY_PUBLIC):
            room, owner, mode = (SSH, owners.root, 0o600)
        disk.write(folder / room / name, data, mode, owner)
    if authorized:
        lines = "".join(f"{line}\n" for line in authorized)
        disk.write(folder / SSH / KEYS, lines.encode(), 0o600, owners.root)


def _check_certificates(certificates: dict[str, bytes], payload_id: str) -> None:
    """All the files there, and of this payload; what is in them the firmware checks."""
    if not certificates:
        raise DeployError(
            f"{CERTIFICATES}/ is missing: put the folder there that `blimp keys payload"
            f" {payload_id}` wrote"
        )
    if missing := [name for name in NEEDED if name not in certificates]:
        raise DeployError(
            f"{CERTIFICATES}/ lacks {', '.join(missing)}: put the whole folder there that"
            f" `blimp keys payload {payload_id}` wrote"
        )
    try:
        name = json.loads(certificates["access.json"])["name"]
    except (ValueError, RecursionError, KeyError, TypeError):
        raise DeployError(f"{CERTIFICATES}/access.json is damaged") from None
    if name != f"payload.{payload_id}":
        raise DeployError(
            f"{CERTIFICATES}/ is of {str(name)[:60]!r}, and 'payload.id' is {payload_id!r}: put the"
            f" folder there that `blimp keys payload {payload_id}` wrote"
        )


def firmware_check(release: Path, user: str = "") -> Check:
    """The firmware's own check, by that release's `--check`, run as `user`."""

    def check(folder: Path) -> None:
        become = []
        if user:
            become = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"]
            become += ["--no-new-privs", "--inh-caps=-all", "--bounding-set=-all"]
        words = [*become, sys.executable or "/usr/bin/python3", "-P", "-m", "pi_firmware"]
        words += ["--check", "--config", str(folder / SETTINGS)]
        words += ["--set", f"telemetry.certificates={folder / CERTIFICATES}"]
        path = f"{release}:{release / 'site'}"
        try:
            run(words, env={"PYTHONPATH": path}, cwd="/", timeout_s=CHECK_LIMIT_S)
        except DeployError as error:
            reason = str(error).removeprefix(f"{Path(words[0]).name}: ")
            reason = reason.removeprefix("pi_firmware: ").replace(str(folder / SETTINGS), SETTINGS)
            reason = reason.replace(f"{folder}/", "")
            raise DeployError(f"the firmware refuses it: {reason}") from None

    return check
