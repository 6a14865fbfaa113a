"""Applies what the boot partition says: `python3 -m deploy.board.provision`, at each boot.

A new provisioning is built beside the one in force, checked whole, and takes its place by a
rename; then the secrets leave the boot partition. Power may go at any point: the next boot goes on
where this one was, and comes to the same. One that is refused changes nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from deploy.board import inputs
from deploy.board.candidate import (
    KEYS,
    RADIO,
    SSH,
    Check,
    Record,
    build,
    firmware_check,
    held_certificates,
    kept_toml,
)
from deploy.board.card import USER, Card, Owners, writable
from deploy.board.disk import Disk, read_bounded
from deploy.board.inputs import HOST_KEY, HOST_KEY_PUBLIC, MOST_BYTES, Inputs, digest
from deploy.board.releases import places, shelf
from deploy.board.releases.places import Places
from deploy.errors import DeployError
from deploy.provisioning.text import parse
from deploy.run import run

IN_FORCE, NONE, REFUSED = "in force", "none", "refused"


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    `reason` is why something was refused, `warning` what is wrong although it is in force;
    `payload_id` is of the provisioning in force, empty without one, `fresh` whether it was taken
    in this boot.
    """

    state: str
    payload_id: str = ""
    reason: str = ""
    warning: str = ""
    fresh: bool = False
    wifi: bool = False


def recover(card: Card, disk: Disk) -> Record | None:
    """Finishes a swap that power interrupted; returns the record of the provisioning in force.

    A folder is whole when its record is: that is written last. After this there is no other folder
    than the one in force.
    """
    new, old = _beside(card)
    if Record.read(card.blimp) is None:
        for folder in (new, old):
            if Record.read(folder) is not None:
                disk.remove(card.blimp)
                disk.rename(folder, card.blimp)
                break
    disk.remove(new)
    disk.remove(old)
    return Record.read(card.blimp)


def provision(card: Card, disk: Disk, owners: Owners, check: Check) -> Outcome:
    """One boot's work; raises nothing but what a power cut is."""
    try:
        held = recover(card, disk)
        outcome = Outcome(IN_FORCE if held else NONE, held.payload_id if held else "")
    except OSError as error:
        return Outcome(NONE, reason=f"the data partition cannot be written: {_describe(error)}")
    try:
        outcome = _take(card, disk, owners, check, held)
    except (DeployError, OSError) as error:
        with contextlib.suppress(OSError):
            disk.remove(_beside(card)[0])
        outcome = replace(outcome, state=REFUSED, reason=_describe(error))
    if outcome.payload_id:
        try:
            install(card, disk, owners)
        except (DeployError, OSError) as error:
            outcome = replace(outcome, warning=f"SSH is not set up: {_describe(error)}")
    return replace(outcome, wifi=(card.blimp / RADIO).exists())


def _take(card: Card, disk: Disk, owners: Owners, check: Check, held: Record | None) -> Outcome:
    found = inputs.read(card)
    if found is None:
        return Outcome(IN_FORCE, held.payload_id) if held else Outcome(NONE)
    fresh = False
    if held is not None:
        found = _without_remnants(card, found, held)
    if held is None or not _is_held(card, found, held):
        held, kept = build(card, disk, owners, found, check, _beside(card)[0])
        _swap(card, disk)
        fresh = True
    elif digest(found.toml) == held.kept:
        kept = found.toml
    else:
        # Taken at an earlier boot, which ended before its password was out.
        kept = kept_toml(found.toml, parse(found.toml))
    warning = ""
    if inputs.is_needed(card, kept):
        try:
            with writable(card):
                inputs.shred(card, disk, kept)
        except (DeployError, OSError) as error:
            warning = f"the secrets are still on the boot partition: {_describe(error)}"
    disk.remove(_beside(card)[1])
    return Outcome(IN_FORCE, held.payload_id, fresh=fresh, warning=warning)


def _without_remnants(card: Card, found: Inputs, held: Record) -> Inputs:
    """The inputs without what this card has taken already, or left half overwritten."""
    if found.torn(held.kept) and found.kept is not None:
        found = replace(found, toml=found.kept)
    if inputs.is_remnant(found.certificates, held_certificates(card.blimp)):
        found = replace(found, certificates={})
    return found


def _is_held(card: Card, found: Inputs, held: Record) -> bool:
    defaults = read_bounded(card.defaults, inputs.MOST_BYTES) or b""
    return (
        digest(found.toml) in (held.toml, held.kept)
        and not found.certificates
        and held.settings == ("" if found.settings is None else digest(found.settings))
        and held.defaults == digest(defaults)
    )


def _swap(card: Card, disk: Disk) -> None:
    new, old = _beside(card)
    disk.remove(old)
    if card.blimp.exists():
        disk.rename(card.blimp, old)
    disk.rename(new, card.blimp)


def _beside(card: Card) -> tuple[Path, Path]:
    """The folders of the one to come and the one before."""
    return card.data / "blimp.new", card.data / "blimp.old"


def _describe(error: BaseException) -> str:
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    return str(error)


def host_name(payload_id: str) -> str:
    """What routers list the payload as; a host's name has no '_' and no '-' at its end."""
    return payload_id.replace("_", "-").strip("-") or USER


def hosts_text(name: str) -> str:
    """hosts(5) of a board of this name; the file lies in memory, as all of /etc does."""
    return "".join(f"{address}\tlocalhost {name}\n" for address in ("127.0.0.1", "::1"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Status 0 whatever came of it: the outcome is told by the light and STATUS.txt."""
    parser = argparse.ArgumentParser(prog="provision", description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=Path("/"), help="the card (for tests)")
    card = Card(parser.parse_args(arguments).root)
    real = card.root == Path("/")
    try:
        name, _ = shelf.in_force(Places(str(card.root)))
        release = Path(Places(str(card.root)).folder(name))
        check = firmware_check(release, USER if real else "")
        owners = Owners.of_system() if real else Owners()
        outcome = provision(card, Disk(), owners, check)
    except (DeployError, OSError) as error:
        outcome = Outcome(NONE, reason=_describe(error))
    if outcome.payload_id and real:
        with contextlib.suppress(OSError):
            name = host_name(outcome.payload_id)
            # First the file: sudo asks for the address of its own host's name and waits for it.
            (card.root / "etc/hosts").write_text(hosts_text(name))
            socket.sethostname(name)
    card.outcome.parent.mkdir(parents=True, exist_ok=True)
    places.write(card.outcome, asdict(outcome), durable=False)
    words = [f"provision: {outcome.state}", outcome.payload_id, outcome.reason, outcome.warning]
    print(": ".join(word for word in words if word), flush=True)
    return 0


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


if __name__ == "__main__":
    sys.exit(main())
