"""A release as a signed bundle: the same release and key give the same bytes."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from tqdm.utils import CallbackIOWrapper

from deploy.board.inputs import digest
from deploy.board.releases import manifest
from deploy.board.releases.choose import MANIFEST, RELEASE
from deploy.board.releases.receive import SIGNATURE
from deploy.errors import DeployError
from deploy.image import release as release_tree
from deploy.run import run

CHECKOUT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Bundle:
    """What is sent: the list, its signature, and the files by their path in the release."""

    listed: manifest.Manifest
    manifest: bytes
    signature: bytes
    files: Mapping[str, bytes]


def release_of(checkout: Path, site: Path | None, machine: str, python: str) -> dict[str, bytes]:
    """The files of a checkout's release for a machine, release.json among them.

    Changes that no commit holds give a version of their own, made now: a commit's name is that of
    its files and of no others.
    """
    tree = release_tree.build(checkout, site, machine, python, release_tree.epoch(checkout))
    files = {}
    for path, entry in tree.items():
        if entry.kind == "link":
            raise DeployError(f"{path}: a release holds no links")
        if entry.kind == "file":
            files[path] = entry.content.read()
    document = json.loads(files[RELEASE])
    if document["version"].endswith(".dirty"):
        del files[RELEASE]
        document["version"] += f".{_digest(files)[:8]}"
        document["made"] = release_tree.utc(int(datetime.now(UTC).timestamp()))
        files[RELEASE] = _json(document)
    return files


def make(files: Mapping[str, bytes], key: Path, replaces: str = "") -> Bundle:
    """Lists and signs a release's files.

    `replaces` is the one newer version that the bundle may take a card back from. Raises
    `DeployError` for what a card would refuse, or when the key does not sign.
    """
    listed = [[path, len(data), digest(data)] for path, data in sorted(files.items())]
    document = {
        "schema": manifest.SCHEMA,
        "release": json.loads(files[RELEASE]),
        "replaces": replaces,
        "files": listed,
    }
    data = _json(document)
    return Bundle(manifest.parse(data), data, sign(data, key), files)


def release_key(keys: Path | None, log: Callable[[str], None] = lambda line: None) -> Path:
    """The key that signs, made by `blimp keys` when this authority has none yet."""
    folder = ["--folder", str(keys)] if keys else []
    words = [sys.executable, "-m", "ground_station.cli", "keys", *folder, "release"]
    done = subprocess.run(words, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise DeployError((done.stderr.strip() or "blimp keys failed").splitlines()[-1])
    if done.stderr.strip():
        log(done.stderr.strip().splitlines()[-1])
    return Path(done.stdout.strip().splitlines()[-1]).absolute()


def sign(data: bytes, key: Path) -> bytes:
    """OpenSSH's signature (PROTOCOL.sshsig) in the namespace of releases."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / MANIFEST
        path.write_bytes(data)
        words = ["ssh-keygen", "-q", "-Y", "sign", "-f", str(key), "-n", manifest.NAMESPACE]
        run([*words, str(path)], timeout_s=60)
        return path.with_name(SIGNATURE).read_bytes()


def write(
    bundle: Bundle,
    out: IO[bytes],
    held: Mapping[str, str] | None = None,
    wrote: Callable[[int], None] = lambda size: None,
) -> None:
    """Writes the bundle's tar.

    Args:
        bundle: what to send.
        out: where to; an `OSError` of it goes through.
        held: path and SHA-256 of the files that the card has, which are left out.
        wrote: called with how many bytes of files went out since it was called last.
    """
    held = held or {}
    with tarfile.open(fileobj=out, mode="w|", format=tarfile.USTAR_FORMAT) as tar:
        _add(tar, MANIFEST, bundle.manifest)
        _add(tar, SIGNATURE, bundle.signature)
        for path, _, sha256 in bundle.listed.files:
            if held.get(path) != sha256:
                _add(tar, path, bundle.files[path], wrote)


def size_to_send(bundle: Bundle, held: Mapping[str, str]) -> int:
    """Bytes of the files that the card does not have."""
    return sum(file.size for file in bundle.listed.files if held.get(file.path) != file.sha256)


def _add(
    tar: tarfile.TarFile,
    path: str,
    data: bytes,
    wrote: Callable[[int], None] = lambda size: None,
) -> None:
    member = tarfile.TarInfo(path)
    member.size, member.mode = len(data), 0o644  # no owner, no time: nothing of this machine
    try:
        tar.addfile(member, CallbackIOWrapper(wrote, io.BytesIO(data), "read"))
    except ValueError:
        raise DeployError(f"{path}: its name is too long for a bundle") from None


def _digest(files: Mapping[str, bytes]) -> str:
    listed = "".join(f"{path} {digest(data)}\n" for path, data in sorted(files.items()))
    return digest(listed.encode())


def _json(document: Any) -> bytes:
    return json.dumps(document, indent=1).encode() + b"\n"
