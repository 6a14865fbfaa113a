"""The signed list of a bundle: what the release is, and every file's size and SHA-256.

    {"schema": "blimp.bundle/1", "release": {…release.json…}, "replaces": "",
     "files": [["pi_firmware/__init__.py", 123, "<sha256>"], …]}

`replaces` names the one version that this bundle may take a card back from. It is signed with the
rest: an old bundle that somebody kept cannot be sent again to bring an old fault back.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from deploy.board.releases import places
from deploy.errors import DeployError
from deploy.run import run

SCHEMA, RELEASE_SCHEMA = "blimp.bundle/1", "blimp.release/1"
NAMESPACE = IDENTITY = "blimp-release"
MOST_BYTES = 4 << 20
MOST_SIGNATURE_BYTES = 8 << 10
MOST_FILES = 20_000
MOST_CONTENT_BYTES = 512 << 20
_ROOMS = ("pi_firmware/", "site/")
_LONGEST_PATH = 250
_NUMBER = r"(?:0|[1-9][0-9]{0,5})"
_VERSION = re.compile(
    rf"({_NUMBER}(?:\.{_NUMBER}){{1,3}})(?:\+[0-9a-z][0-9a-z.]{{0,40}})?", re.ASCII
)
_MADE = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)
_WORD = re.compile(r"[0-9A-Za-z_.-]{1,32}", re.ASCII)


class Release(NamedTuple):
    """What release.json says."""

    version: str
    machine: str
    python: str
    made: str

    @property
    def age(self) -> tuple[tuple[int, ...], str]:
        """Newer releases have the greater one: by version number, then by when it was made.

        What stands behind the '+' names a commit and has no order.
        """
        match = _VERSION.fullmatch(self.version)
        assert match is not None  # read_release saw to it
        numbers = [int(number) for number in match[1].split(".")]
        return tuple(numbers + [0] * (4 - len(numbers))), self.made


class File(NamedTuple):
    """One file of a release; its path is relative to the release's folder."""

    path: str
    size: int
    sha256: str


class Manifest(NamedTuple):
    """A bundle's list, checked."""

    release: Release
    replaces: str
    files: tuple[File, ...]

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)


def read_release(document: Any, where: str) -> Release:
    """Checks what a release.json holds; raises `DeployError`."""
    if not isinstance(document, dict) or document.get("schema") != RELEASE_SCHEMA:
        raise DeployError(f"{where}: not of schema {RELEASE_SCHEMA}")
    values = {}
    for name, form in (
        ("version", _VERSION),
        ("machine", _WORD),
        ("python", _WORD),
        ("made", _MADE),
    ):
        value = document.get(name)
        if not isinstance(value, str) or not form.fullmatch(value):
            raise DeployError(f"{where}: '{name}' is {str(value)[:60]!r}")
        values[name] = value
    if not places.is_name(values["version"]):
        raise DeployError(f"{where}: 'version' is {values['version']!r}, which can name no folder")
    return Release(**values)


def load_release(folder: Path) -> Release:
    """A release folder's release.json; raises `DeployError`."""
    path = folder / "release.json"
    return read_release(places.read(path), str(path))


def parse(data: bytes) -> Manifest:
    """Checks a bundle's list; raises `DeployError` with the first thing that may not be."""
    if len(data) > MOST_BYTES:
        raise DeployError(f"the bundle's list has {len(data)} bytes; allowed: {MOST_BYTES}")
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        raise DeployError("the bundle's list is not JSON text") from None
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise DeployError(f"the bundle's list is not of schema {SCHEMA}")
    release = read_release(document.get("release"), "the bundle's release")
    replaces, listed = document.get("replaces"), document.get("files")
    if not isinstance(replaces, str) or not isinstance(listed, list):
        raise DeployError("the bundle's list lacks 'replaces' or 'files'")
    if len(listed) > MOST_FILES:
        raise DeployError(f"the bundle has {len(listed)} files; allowed: {MOST_FILES}")
    files = tuple(_file(entry) for entry in listed)
    paths = [file.path for file in files]
    if len(set(paths)) != len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise DeployError(f"the bundle lists {twice!r} twice")
    if paths != sorted(paths) or "pi_firmware/__main__.py" not in set(paths):
        raise DeployError("the bundle's list is not in order, or holds no firmware")
    inner = {path.rpartition("/")[0] for path in paths}
    if both := {part for folder in inner for part in _parents(folder)} & set(paths):
        raise DeployError(f"the bundle has {min(both)!r} as file and as folder")
    made = Manifest(release, replaces, files)
    if made.size > MOST_CONTENT_BYTES:
        raise DeployError(f"the bundle has {made.size} bytes; allowed: {MOST_CONTENT_BYTES}")
    return made


def _file(entry: Any) -> File:
    if not isinstance(entry, list) or len(entry) != 3:
        raise DeployError(f"the bundle's list has the entry {str(entry)[:60]!r}")
    path, size, sha256 = entry
    if not isinstance(path, str) or not is_path(path):
        raise DeployError(f"the bundle lists {str(path)[:80]!r}, which is no path of a release")
    if isinstance(size, bool) or not isinstance(size, int) or size < 0:
        raise DeployError(f"the bundle lists {path!r} with {str(size)[:20]} bytes")
    if not isinstance(sha256, str) or not _SHA256.fullmatch(sha256):
        raise DeployError(f"the bundle lists {path!r} without a SHA-256")
    return File(path, size, sha256)


def is_path(path: str) -> bool:
    """Whether a text names a file inside a release's rooms, and nothing else anywhere."""
    if path == "release.json":
        return True
    parts = path.split("/")
    return (
        path.startswith(_ROOMS)
        and len(path.encode(errors="replace")) <= _LONGEST_PATH
        and path.isprintable()
        and "\\" not in path
        and all(part not in ("", ".", "..") for part in parts)
    )


def _parents(folder: str) -> list[str]:
    parts = folder.split("/")
    return ["/".join(parts[: end + 1]) for end in range(len(parts))]


def verify(data: bytes, signature: bytes, signers: Path) -> None:
    """Raises `DeployError` when none of the release keys of this card signed the list.

    The signature is OpenSSH's (PROTOCOL.sshsig), in the namespace of releases: a key's signature
    on anything else is none here.
    """
    if not signers.is_file():
        again = "provision it with a folder that 'blimp keys release' brought up to date"
        raise DeployError(f"this card trusts no release key ({signers} is missing): {again}")
    with tempfile.NamedTemporaryFile(suffix=".sig") as file:
        file.write(signature)
        file.flush()
        words = ["ssh-keygen", "-Y", "verify", "-f", str(signers), "-I", IDENTITY, "-n", NAMESPACE]
        try:
            run([*words, "-s", file.name], input=data, timeout_s=60)
        except DeployError as error:
            raise DeployError(
                f"the bundle's signature is of no release key that this card trusts ({error})"
            ) from None


def check_against(manifest: Manifest, factory: Release, running: Release) -> None:
    """Raises `DeployError` unless the bundle is for this card and not older than what it runs."""
    new = manifest.release
    for name in ("machine", "python"):
        wanted, given = getattr(factory, name), getattr(new, name)
        if given != wanted:
            raise DeployError(f"the bundle is for {name} {given}, this card's is {wanted}")
    if new.age < running.age and manifest.replaces != running.version:
        raise DeployError(
            f"the bundle's {new.version} of {new.made} is older than {running.version} of"
            f" {running.made}, which runs; --allow-older signs a bundle that may replace it"
        )


def sha256_of(path: Path) -> str:
    """A file's SHA-256; raises `OSError`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
