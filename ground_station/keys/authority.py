"""The authority's folder: what it signed, for whom, and the folders to copy to the machines.

    FOLDER/authority.json         members and the step of a rotation
    FOLDER/authorities/N.pem|key  the authorities, newest last
    FOLDER/releases/N|N.pub       the keys that sign releases of the firmware, newest last
    FOLDER/payload/ID/            to copy to the payload: certificate, access list, SRTP, SSH, and
                                  whose releases it takes (allowed_signers)
    FOLDER/ground/NAME/           to copy to the ground station: the same, and all SRTP keys

Zenoh reads no revocation list. A revoked name leaves the access lists of all others, which holds on
each machine once its new folder is there and its program was restarted; a rotation of the
authority ends what the old one signed, whatever the lists say. The key of the releases goes along
with it, step by step.

`authority.json` is written last, and whatever was cut short before may be done again: a member's
folder gets its name when it is whole.
"""

from __future__ import annotations

import datetime
import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ground_station.errors import KeysError
from ground_station.keys import certificates
from ground_station.keys.certificates import Pair
from pi_firmware.wire import credentials, files, keys
from pi_firmware.wire.credentials import GROUND, PAYLOAD
from pi_firmware.wire.errors import TelemetryError, os_errors_as

SCHEMA = "blimp.authority/1"
AUTHORITY_DAYS, CERTIFICATE_DAYS = 3650, 730
STEPS = ("settled", "both trusted", "new certificates")
SRTP, SSH, SIGNERS = "srtp.key", "ssh_ed25519", "allowed_signers"
RELEASES = "blimp-release"
"""Name and OpenSSH namespace of what the release keys sign."""
_LOCK_S = 10.0


class Authority:
    """An authority's folder, read; raises `KeysError` with one line when it is none."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            document = json.loads((folder / "authority.json").read_bytes())
            self.members: dict[str, dict[str, Any]] = dict(document["members"])
            self.trusted: list[int] = [int(number) for number in document["trusted"]]
            self.signing, self.step = int(document["signing"]), int(document["step"])
            known = document["schema"] == SCHEMA and 0 <= self.step < len(STEPS)
            for name in self.members:
                credentials.check_name(name)
        except FileNotFoundError:
            raise KeysError(f"{folder}: no authority here; make one: blimp keys init") from None
        except OSError as error:
            raise KeysError(f"{folder}: {error.strerror or error}") from None
        except (
            LookupError,
            ValueError,
            TypeError,
            ArithmeticError,
            RecursionError,
            AttributeError,
        ):
            known = False
        if not known:
            raise KeysError(f"{folder}/authority.json: not of schema {SCHEMA}")

    @classmethod
    def create(cls, folder: Path) -> Authority:
        """A new authority; raises `KeysError` when the folder holds more than one cut short."""
        begun = {"authorities", "releases", f"authority.json{files.PART}"}  # it signed nothing
        if folder.exists() and (
            not folder.is_dir() or {path.name for path in folder.iterdir()} - begun
        ):
            raise KeysError(f"{folder}: exists already, and keys are never overwritten")
        _folder(folder)
        self = cls.__new__(cls)
        self.folder, self.members, self.trusted, self.signing, self.step = folder, {}, [1], 1, 0
        self._make(1)
        self._save()
        return self

    def add(self, role: str, member: str, days: int = CERTIFICATE_DAYS) -> Path:
        """A new machine's folder, or the one that was whole when this was cut short.

        Raises `KeysError` when the name is taken or was revoked.
        """
        name = f"{role}.{_member(member)}"
        if name in self.members:
            state = "was revoked" if self.members[name]["revoked"] else "exists already"
            raise KeysError(f"{role} '{member}' {state}; take another name")
        wanted = [credentials.CERTIFICATE, f"{SSH}.pub", *([SRTP] if role == PAYLOAD else [])]
        if not all((self.of(name) / file).is_file() for file in wanted):
            shutil.rmtree(self.of(name), ignore_errors=True)  # of an older program that was cut
            part = self.folder / f"{name}{files.PART}"
            shutil.rmtree(part, ignore_errors=True)
            self._sign(name, days, _folder(part))
            private, public = certificates.make_ssh_key()
            write_private(part / SSH, private)
            write_private(part / f"{SSH}.pub", public)
            if role == PAYLOAD:
                write_private(part / SRTP, certificates.make_srtp_key())
            _move(part, self.of(name))
        self.members[name] = {"revoked": False, "days": days}
        self._save()
        return self.of(name)

    def renew(self, name: str, days: int = CERTIFICATE_DAYS) -> Path:
        """Gives a member a new certificate and its key; SRTP and SSH keys stay."""
        credentials.check_name(name)
        if name not in self.live():
            raise KeysError(f"{name}: no such member, or revoked")
        self._sign(name, days, self.of(name))
        self.members[name]["days"] = days
        self._save()
        return self.of(name)

    def revoke(self, name: str) -> None:
        """Takes a name out of all access lists; its files move to `revoked/`."""
        credentials.check_name(name)
        if name not in self.members or not (name in self.live() or self.of(name).exists()):
            raise KeysError(f"{name}: no such member, or revoked already")
        self.members[name]["revoked"] = True
        self._save()
        _move(self.of(name), self.folder / "revoked" / name)

    def rotate(self) -> str:
        """Goes one step of a rotation and says which it was.

        First all trust the old and the new authority, then all get certificates of the new one,
        then the old one goes. Machines whose folders were copied after each step speak throughout.
        """
        if self.step == 0:
            self._make(self.signing + 1)
            self.trusted = [self.signing, self.signing + 1]
        elif self.step == 1:
            self.signing = self.trusted[-1]
            for name in self.live():
                self._sign(name, self.members[name]["days"], self.of(name))
        else:
            self.trusted = [self.signing]
        self.step = (self.step + 1) % len(STEPS)
        self._save()
        return STEPS[self.step]

    def release_key(self) -> tuple[Path, bool]:
        """The private key that signs releases now, and whether it had to be made.

        Raises `KeysError` when somebody took it away: another one would be trusted by no card.

        An authority older than releases has none: it gets one, and its payloads' folders the public
        part, which reaches a card only when it is provisioned again.
        """
        path = self.folder / "releases" / str(self.signing)
        made = not path.with_name(f"{path.name}.pub").is_file()
        self._save()
        if not path.is_file():
            raise KeysError(f"{path}: the key that signs releases is not here; bring it back")
        return path, made

    def live(self) -> list[str]:
        """The common names that are not revoked, sorted."""
        return sorted(name for name, entry in self.members.items() if not entry["revoked"])

    def of(self, name: str) -> Path:
        """The folder of a common name's files."""
        return self.folder.joinpath(*name.split(".", 1))

    def check(self, now: datetime.datetime, soon_days: int = 30) -> list[str]:
        """What is wrong, one line each: missing or open files, wrong or ending certificates.

        Also a private key that is not its certificate's, the authorities' own among them.
        """
        problems = []
        for number in self.trusted:
            try:
                certificates.check_key(self._pair(number))
            except KeysError as error:
                problems.append(f"authority {number}: {error}")
        for name in self.live():
            try:
                held = credentials.load(self.of(name))
                common, until = inspect(held.folder)
            except (TelemetryError, KeysError, OSError) as error:
                problems.append(f"{name}: {error}")
                continue
            if name.startswith(PAYLOAD) and not self._trusts_releases(held.folder):
                problems.append(f"{name}: takes no releases of this authority; 'release' fixes it")
            if common != name or held.name != name:
                problems.append(f"{name}: the certificate is {common}'s")
            if (set(held.peers), set(held.stations)) != (
                set(self._peers(name)), set(self._stations(name)),
            ):  # fmt: skip
                problems.append(f"{name}: its access list is not the authority's")
            if until - now < datetime.timedelta(days=soon_days):
                problems.append(f"{name}: ends on {until:%Y-%m-%d}; 'renew' fixes it")
        for path in sorted(self.folder.rglob("*")):
            if path.is_file() and path.stat().st_mode & 0o077:
                problems.append(f"{path}: others can read it; allowed is mode 0600")
        return problems

    def _peers(self, name: str) -> list[str]:
        other = GROUND if name.startswith(PAYLOAD) else PAYLOAD
        return [peer for peer in self.live() if peer.startswith(other + ".")]

    def _stations(self, name: str) -> list[str]:
        """The other ground stations that a ground station may work side by side with."""
        if name.startswith(PAYLOAD):
            return []
        return [one for one in self.live() if one.startswith(GROUND + ".") and one != name]

    def _sign(self, name: str, days: int, folder: Path) -> None:
        pair = certificates.make_certificate(name, self._pair(self.signing), _until(days))
        write_private(folder / credentials.KEY, pair.key, replace=True)
        write_private(folder / credentials.CERTIFICATE, pair.certificate, replace=True)

    def _make(self, number: int) -> None:
        pair = certificates.make_authority(f"blimp authority {number}", _until(AUTHORITY_DAYS))
        folder = _folder(self.folder / "authorities")
        # A step that was cut short leaves its authority behind; it signed nothing yet.
        write_private(folder / f"{number}.key", pair.key, replace=True)
        write_private(folder / f"{number}.pem", pair.certificate, replace=True)

    def _pair(self, number: int) -> Pair:
        folder = self.folder / "authorities"
        try:
            return Pair(
                (folder / f"{number}.pem").read_bytes(), (folder / f"{number}.key").read_bytes()
            )
        except OSError as error:
            raise KeysError(f"{error.filename}: {error.strerror}") from None

    def _save(self) -> None:
        """Writes the members' trust and access lists, then the authority's own file."""
        bundle = b"".join(self._pair(number).certificate for number in self.trusted)
        self._make_release_keys()
        signers = self._signers()
        live = self.live()
        for name in live:
            access: dict[str, Any] = {"schema": credentials.SCHEMA, "name": name}
            access |= {"peers": self._peers(name), "stations": self._stations(name)}
            folder = self.of(name)
            write_private(folder / credentials.AUTHORITIES, bundle, replace=True)
            write_private(folder / credentials.ACCESS, _json(access), replace=True)
            if name.startswith(PAYLOAD):
                write_private(folder / SIGNERS, signers, replace=True)
            else:
                self._give_srtp(folder, [peer for peer in live if peer.startswith(PAYLOAD)])
        document = {
            "schema": SCHEMA,
            "signing": self.signing,
            "trusted": self.trusted,
            "step": self.step,
            "members": self.members,
        }
        write_private(self.folder / "authority.json", _json(document), replace=True)

    def _make_release_keys(self) -> None:
        """A key for each trusted number that has none; Ed25519, like the machines' SSH keys."""
        folder = _folder(self.folder / "releases")
        for number in self.trusted:
            if not (folder / f"{number}.pub").is_file():
                private, public = certificates.make_ssh_key()
                write_private(folder / str(number), private, replace=True)
                write_private(folder / f"{number}.pub", public)  # last: it says that both are made

    def _signers(self) -> bytes:
        """OpenSSH's allowed signers: the trusted keys, without dates: a card may boot in 1970."""
        public = [self.folder / "releases" / f"{number}.pub" for number in self.trusted]
        who = f'{RELEASES} namespaces="{RELEASES}" '.encode()
        return b"".join(who + path.read_bytes() for path in public)

    def _trusts_releases(self, folder: Path) -> bool:
        try:
            return (folder / SIGNERS).read_bytes() == self._signers()
        except OSError:
            return False

    def _give_srtp(self, ground: Path, payloads: list[str]) -> None:
        folder = _folder(ground / "srtp")
        kept = {f"{name.partition('.')[2]}.key": self.of(name) / SRTP for name in payloads}
        for old in folder.iterdir():
            if old.name not in kept:
                old.unlink()
        for file_name, source in kept.items():
            write_private(folder / file_name, source.read_bytes(), replace=True)


def inspect(folder: Path) -> tuple[str, datetime.datetime]:
    """Common name and end of the certificate in a machine's folder.

    Raises `KeysError` when no authority in it signed that, or its private key is another's.
    """
    pair = Pair(
        (folder / credentials.CERTIFICATE).read_bytes(), (folder / credentials.KEY).read_bytes()
    )
    found = certificates.inspect(pair.certificate, (folder / credentials.AUTHORITIES).read_bytes())
    certificates.check_key(pair)
    return found


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """One program changes an authority at a time; raises `KeysError` when another does not end."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # whoever reads it says what is wrong
        yield
        return
    try:
        until_s = time.monotonic() + _LOCK_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > until_s:
                    raise KeysError(f"{folder}: another 'blimp keys' is at work; end it") from None
                time.sleep(0.05)
        yield
    finally:
        os.close(descriptor)


def write_private(path: Path, data: bytes, *, replace: bool = False) -> None:
    """Writes a file that only its owner can read, whole or not at all.

    Raises `KeysError` with one line when it exists and `replace` is not set.
    """
    with os_errors_as(path, KeysError):
        if path.exists() and not replace:
            raise KeysError(f"{path}: exists already, and keys are never overwritten")
        files.write(path, data, 0o600)


def _folder(path: Path) -> Path:
    with os_errors_as(path, KeysError):
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    return path


def _move(part: Path, path: Path) -> None:
    _folder(path.parent)
    with os_errors_as(path, KeysError):
        files.replace(part, path)
        files.sync(part.parent)


def _member(member: str) -> str:
    try:
        return keys.check_payload_id(member)
    except TelemetryError as error:
        raise KeysError(str(error).replace("payload_id", "name", 1)) from None


def _until(days: int) -> datetime.datetime:
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    return now + datetime.timedelta(days=days)


def _json(document: Any) -> bytes:
    return (json.dumps(document, indent=2) + "\n").encode()
