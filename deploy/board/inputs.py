"""What a person has put onto the boot partition, read with bounds and told apart from what is old.

Two traces of the card's own work are no new input: a blimp.toml from which it took the password,
and files of certificates/ that it was overwriting with zeros when power went: once the card has the
secrets, each file is overwritten in its own blocks, written through, and only then removed. On
flash memory that is all a program can do: the card's controller may keep old cells out of
everybody's sight.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from deploy.board.card import Card
from deploy.board.disk import Disk, read_bounded
from deploy.errors import DeployError

FILE, KEPT_FILE, SETTINGS, CERTIFICATES = "blimp.toml", "blimp.new", "payload.toml", "certificates"
MOST_BYTES = 256 * 1024
MOST_CERTIFICATE_BYTES = 64 * 1024
NEEDED = ("ca.pem", "certificate.pem", "key.pem", "access.json", "srtp.key")
HOST_KEY, HOST_KEY_PUBLIC = "ssh_ed25519", "ssh_ed25519.pub"
SIGNERS = "allowed_signers"  # of updates
KNOWN = (*NEEDED, SIGNERS, HOST_KEY, HOST_KEY_PUBLIC)


def digest(data: bytes) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


@dataclass(frozen=True)
class Inputs:
    """The boot partition's folder; `kept` is what blimp.toml becomes without its password."""

    toml: bytes
    settings: bytes | None = None
    kept: bytes | None = None
    certificates: dict[str, bytes] = field(default_factory=dict)

    def torn(self, kept_digest: str) -> bool:
        """Whether power went while the password was taken out: zeros, and the whole beside it.

        An editor writes no zero bytes, so that a person's own change is never taken for it.
        """
        whole = self.kept is not None and digest(self.kept) == kept_digest
        return whole and (b"\0" in self.toml or not self.toml)


def read(card: Card) -> Inputs | None:
    """What is there; None without a blimp.toml.

    Raises `DeployError` that names what is too large or cannot be read, or that certificates/ holds
    other things than certificates.
    """
    toml = _bytes(card.boot / FILE, MOST_BYTES)
    if toml is None:
        if (card.boot / f"{FILE}.txt").exists():  # an editor's doing, which the laptop hides
            raise DeployError(f"there is {FILE}.txt and no {FILE}: take .txt off its name")
        return None
    folder = card.boot / CERTIFICATES
    certificates = {}
    for name in KNOWN:
        data = _bytes(folder / name, MOST_CERTIFICATE_BYTES)
        if data is not None:
            certificates[name] = data
    if not certificates and folder.is_dir() and any(folder.iterdir()):
        raise DeployError(
            f"{CERTIFICATES}/ holds none of {', '.join(NEEDED)}: put the files themselves there"
        )
    return Inputs(
        toml,
        settings=_bytes(card.boot / SETTINGS, MOST_BYTES),
        kept=_bytes(card.boot / KEPT_FILE, MOST_BYTES),
        certificates=certificates,
    )


def is_remnant(found: dict[str, bytes], applied: dict[str, bytes]) -> bool:
    """Whether all of the certificates found were taken already: the same, or zeros over the same.

    `applied` are those that the card holds. None at all are one, too.
    """
    return all(
        name in applied and len(data) <= len(applied[name]) and _is_zeroed(data, applied[name])
        for name, data in found.items()
    )


def _is_zeroed(data: bytes, applied: bytes) -> bool:
    return all(byte in (0, was) for byte, was in zip(data, applied, strict=False))


def _bytes(path: Path, most: int) -> bytes | None:
    where = path.relative_to(path.parents[1]) if path.parent.name == CERTIFICATES else path.name
    try:
        data = read_bounded(path, most)
    except NotADirectoryError:
        return None
    except OSError as error:
        raise DeployError(f"{where}: {error.strerror or error}") from None
    if data is not None and len(data) > most:
        raise DeployError(f"{where} has more than {most} bytes")
    return data


def is_needed(card: Card, kept: bytes) -> bool:
    """Whether anything is left to be taken out."""
    try:
        same = (card.boot / FILE).read_bytes() == kept
    except OSError:
        same = False
    return not same or (card.boot / KEPT_FILE).exists() or (card.boot / CERTIFICATES).exists()


def shred(card: Card, disk: Disk, kept: bytes) -> None:
    """Makes blimp.toml what `kept` says and removes certificates/; raises `OSError`.

    blimp.toml is overwritten with zeros first: a file half zeros is no valid TOML, so that it can't
    be mistaken for one that a person wrote, and the whole lies beside it meanwhile.
    """
    file, beside = card.boot / FILE, card.boot / KEPT_FILE
    if file.read_bytes() != kept:
        disk.write(beside, kept)
        # As long as what comes then: until that is whole there are zeros in it.
        disk.overwrite(file, bytes(max(file.stat().st_size, len(kept))))
        disk.overwrite(file, kept)
    disk.remove(beside)
    _shred_folder(card.boot / CERTIFICATES, disk)


def _shred_folder(folder: Path, disk: Disk) -> None:
    """Those that we know last: a folder that power left half empty still has one of them."""
    if not folder.is_dir():
        return
    ours = {folder / name for name in KNOWN}
    for path in sorted(folder.rglob("*"), key=lambda path: (path in ours, path)):
        if path.is_file() and not path.is_symlink():
            disk.overwrite(path, bytes(path.stat().st_size))
            disk.remove(path)
    disk.remove(folder)
