"""SSH's files in /data/ssh, from the provisioning in force; the same again changes nothing."""

from __future__ import annotations

from pathlib import Path

from deploy.board.candidate import KEYS, SSH
from deploy.board.card import Card, Owners
from deploy.board.disk import Disk, read_bounded
from deploy.board.inputs import HOST_KEY, HOST_KEY_PUBLIC, MOST_BYTES
from deploy.run import run

HOST_KEY_FILE = "ssh_host_ed25519_key"


def install(card: Card, disk: Disk, owners: Owners) -> None:
    """Host key and authorized_keys; without a key of a person's, no authorized_keys, so no sshd.

    The host key is the one that came with the certificates, so that the ground station knows this
    payload by it; without one, a key of the card's own. Raises `DeployError` and `OSError`.
    """
    source = card.blimp / SSH
    authorized = read_bounded(source / KEYS, MOST_BYTES)
    if authorized is None:
        disk.remove(card.ssh / KEYS)
        return
    if not card.ssh.is_dir():
        disk.make_folder(card.ssh, 0o755, owners.root)
    host = read_bounded(source / HOST_KEY, MOST_BYTES)
    public = read_bounded(source / HOST_KEY_PUBLIC, MOST_BYTES)
    key = card.ssh / HOST_KEY_FILE
    if host is not None:
        _put(disk, key, host, 0o600, owners)
        if public is not None:
            _put(disk, Path(f"{key}.pub"), public, 0o644, owners)
    elif not key.is_file():
        _make(disk, key)
    # sshd reads it as the one who logs in.
    _put(disk, card.ssh / KEYS, authorized, 0o644, owners)


def _put(disk: Disk, path: Path, data: bytes, mode: int, owners: Owners) -> None:
    if read_bounded(path, MOST_BYTES) == data:
        return
    part = path.with_name(path.name + ".part")
    disk.write(part, data, mode, owners.root)
    disk.rename(part, path)


def _make(disk: Disk, key: Path) -> None:
    part = key.with_name(key.name + ".part")
    for path in (part, Path(f"{part}.pub")):
        disk.remove(path)
    run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", part], timeout_s=60)
    disk.rename(Path(f"{part}.pub"), Path(f"{key}.pub"))
    disk.rename(part, key)
