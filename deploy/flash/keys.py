"""The payload's folder of `blimp keys`, taken as files: the right one, complete, not revoked."""

from __future__ import annotations

import contextlib
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deploy.board.inputs import KNOWN, NEEDED
from deploy.errors import DeployError
from deploy.flash.wishes import read_file

FLASHED, FLASHED_SCHEMA = "flashed.json", "blimp.flashed/1"
_ACCESS_SCHEMA = "blimp.access/1"


@dataclass(frozen=True)
class Keys:
    """A payload's files by name, and the ground stations that it talks to, as ground.main."""

    files: dict[str, bytes]
    peers: tuple[str, ...]


def load(folder: Path, payload: str) -> Keys:
    """Reads what `blimp keys payload ID` wrote; raises `DeployError` with one line."""
    place = folder / "payload" / payload
    if not place.is_dir():
        if (folder / "revoked" / f"payload.{payload}").exists():
            raise DeployError(f"{folder}: the payload '{payload}' was revoked; take another name")
        raise DeployError(
            f"{place}: no keys for '{payload}'; make them: blimp keys payload {payload}"
            " (another folder: --keys)"
        )
    files = {name: read_file(place / name) for name in NEEDED}
    files |= {name: read_file(place / name) for name in KNOWN if (place / name).exists()}
    access = _access(place, files["access.json"])
    name, peers = access.get("name"), access.get("peers")
    if name != f"payload.{payload}":
        raise DeployError(f"{place}: these keys are those of {str(name)[:60]!r}, not of {payload}")
    if not isinstance(peers, list) or not all(isinstance(peer, str) for peer in peers):
        raise DeployError(f"{place / 'access.json'}: 'peers' is not a list of names")
    if not peers:
        raise DeployError(
            f"{place}: they list no ground station, so nobody would hear the payload;"
            " make one first: blimp keys ground main"
        )
    for file in ("ca.pem", "certificate.pem", "key.pem"):
        if b"-----BEGIN " not in files[file] or b"-----END " not in files[file]:
            raise DeployError(f"{place / file}: not PEM, or cut")
    return Keys(files, tuple(peers))


def remember(folder: Path, payload: str, held: Keys) -> None:
    """Notes beside the keys which stations the payload's card was told, for `blimp doctor`.

    Keys change when a station is added, the card only when it is written again. A note that cannot
    be written is left out.
    """
    place = folder / "payload" / payload
    note = {"schema": FLASHED_SCHEMA, "peers": held.peers, "time_s": int(time.time())}
    with contextlib.suppress(OSError):
        owner, part = place.stat(), place / f"{FLASHED}.part"
        part.unlink(missing_ok=True)
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            os.fchown(file.fileno(), owner.st_uid, owner.st_gid)  # under sudo it is root's
            file.write(json.dumps(note) + "\n")
        part.replace(place / FLASHED)


def ground_ssh_keys(folder: Path, peers: tuple[str, ...]) -> tuple[str, ...]:
    """The public SSH keys of those ground stations, as far as the folder has them."""
    lines = []
    for peer in peers:
        role, _, name = peer.partition(".")
        file = folder / role / name / "ssh_ed25519.pub"
        if role == "ground" and name and "/" not in name and file.is_file():
            key = read_file(file).decode(errors="replace").strip()
            # blimp keys writes no comment; with one it is plain on the card whose key it is.
            lines.append(key if len(key.split()) > 2 else f"{key} {peer}")
    return tuple(lines)


def read_ssh_key(path: Path) -> list[str]:
    """The public keys in a `.pub` file, comments and empty lines left out."""
    lines = read_file(path).decode(errors="replace").splitlines()
    found = [line for line in map(str.strip, lines) if line and not line.startswith("#")]
    if not found:
        raise DeployError(f"{path}: no public key in it")
    return found


def _access(place: Path, data: bytes) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("schema") != _ACCESS_SCHEMA:
        raise DeployError(f"{place / 'access.json'}: not of schema {_ACCESS_SCHEMA}")
    return document
