"""Takes a bundle from a stream: signature first, then every file, then the switch.

Nothing is written before the list's signature is good, and nothing is switched before every byte
was read back from the card. A stream that ends early, or a full card, leaves all as it was.

The stream is a tar, POSIX ustar (IEEE 1003.1, pax utility): 512-byte headers, content filled up to
the next multiple. Python's own reader of whole archives knows links, devices, sparse files and
extended headers of any size; all of these have no place in a bundle, so here it reads one header at
a time, and whatever is not a plain file with a sum that fits ends it.
"""

from __future__ import annotations

import compileall
import contextlib
import hashlib
import os
import py_compile
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from deploy.board.releases import manifest, places, shelf
from deploy.board.releases.choose import MANIFEST, RELEASE
from deploy.board.releases.manifest import File, Manifest, Release
from deploy.board.releases.places import FACTORY, Places
from deploy.board.releases.service import Service
from deploy.errors import DeployError

BLOCK = 512
_CHUNK = 1 << 18
_CUT = "the bundle is cut: it ended early"


class Member:
    """A file in the stream: its name and size, and its bytes, once."""

    def __init__(self, name: str, size: int, stream: BinaryIO) -> None:
        self.name, self.size = name, size
        self._stream, self._left = stream, size

    def chunks(self) -> Iterator[bytes]:
        """The content in pieces; raises `DeployError` when the stream ends before."""
        while self._left:
            data = _exactly(self._stream, min(self._left, _CHUNK))
            self._left -= len(data)
            yield data

    def bytes(self, most: int) -> bytes:
        """All of the content; raises `DeployError` when it is more than `most`."""
        if self.size > most:
            raise DeployError(f"the bundle's {self.name} has {self.size} bytes; allowed: {most}")
        return b"".join(self.chunks())

    def finish(self) -> None:
        """Reads past what is left and the filling."""
        for _ in self.chunks():
            pass
        _exactly(self._stream, -self.size % BLOCK)


def members(stream: BinaryIO) -> Iterator[Member]:
    """The files of a tar, in order; raises `DeployError` at the first thing that is none."""
    while True:
        header = _exactly(stream, BLOCK)
        if not any(header):
            if any(_exactly(stream, BLOCK)):
                raise DeployError("the bundle is not a tar: its end is not one")
            return
        member = Member(*_header(header), stream)
        yield member
        member.finish()


def _header(block: bytes) -> tuple[str, int]:
    """Name and size."""
    if block[257:265] != b"ustar\00000":
        raise DeployError("the bundle is not a plain tar (ustar)")
    try:
        found = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
    except (tarfile.HeaderError, ValueError) as error:
        raise DeployError(f"the bundle is damaged: a header: {error}") from None
    if found.type != tarfile.REGTYPE or found.size < 0:
        raise DeployError(f"the bundle's {found.name[:80]!r} is no plain file")
    if mode := found.mode & ~0o777:
        raise DeployError(f"the bundle's {found.name[:80]!r} has the mode bits {mode:o}")
    return found.name, found.size


def _exactly(stream: BinaryIO, size: int) -> bytes:
    parts = []
    while size:
        data = stream.read(size)
        if not data:
            raise DeployError(_CUT)
        parts.append(data)
        size -= len(data)
    return b"".join(parts)


SIGNATURE = MANIFEST + ".sig"
_FILE_SYSTEM_BYTES = 4096  # what a file takes beside its content, at most
_SPARE_BYTES = 4 << 20


def receive(
    at: Places, stream: BinaryIO, service: Service, *, force: bool = False
) -> dict[str, Any]:
    """Takes a bundle and switches to it, on trial; gives its `version` and the trial's `id`.

    While the autopilot is armed only with `force`: the firmware is restarted. Raises
    `DeployError` with one line, and the card is as it was.
    """
    with shelf.lock(at):
        try:
            return _receive(at, stream, service, force)
        except OSError as error:
            raise DeployError(f"{error.filename or at.releases}: {error.strerror}") from None


def _receive(at: Places, stream: BinaryIO, service: Service, force: bool) -> dict[str, Any]:
    _check_disarmed(service, force)
    if (trial := shelf.settle(at, service)) is not None:
        raise DeployError(f"{trial['release']} is still on trial; wait until that is decided")
    shelf.prune(at)
    sent = members(stream)
    data = _named(sent, MANIFEST).bytes(manifest.MOST_BYTES)
    signature = _named(sent, SIGNATURE).bytes(manifest.MOST_SIGNATURE_BYTES)
    manifest.verify(data, signature, at.signers)
    listed = manifest.parse(data)
    factory = manifest.load_release(at.factory)
    _, running = shelf.in_force(at)
    manifest.check_against(listed, factory, running)
    name = listed.release.version
    if name == running.version:
        return _again(at, running, listed)
    _make_room(at, listed)
    part = at.releases / f"{name}.part"
    try:
        _unpack(at, part, sent, listed, data)
        if wrong := shelf.hash_fault(part, listed):
            raise DeployError(wrong)
        _compile(part, at.folder(name))
        if at.folder(name).is_dir():  # not the one in force
            shelf.discard(at.folder(name))
        _check_disarmed(service, force)  # sending takes minutes
        part.rename(at.folder(name))
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    places.sync_folder(at.releases)
    trial_id = shelf.begin(at, name, telemetry=service.seen().telemetry)
    service.watch()
    return {"version": name, "id": trial_id}


def _check_disarmed(service: Service, force: bool) -> None:
    if not force and service.seen().armed:
        raise DeployError("the autopilot is armed: disarm it, or say --force")


def _named(members: Iterator[Member], name: str) -> Member:
    member = next(members, None)
    if member is None or member.name != name:
        raise DeployError(f"the bundle does not have {name} where it must be")
    return member


def _again(at: Places, running: Release, listed: Manifest) -> dict[str, Any]:
    """Of a bundle of the very version that runs: nothing to do, when it is the same."""
    held = holds(at)
    for file in listed.files:
        if file.path != RELEASE and held.get(file.path) != file.sha256:
            raise DeployError(f"{running.version} runs already, with another {file.path}")
    return {"version": running.version, "id": ""}


def _make_room(at: Places, listed: Manifest) -> None:
    """Raises `DeployError` when the card is too full; the release before the last goes first."""
    need = listed.size + len(listed.files) * _FILE_SYSTEM_BYTES + _SPARE_BYTES
    if _free(at) < need and at.linked("previous") != FACTORY:
        at.point("previous", FACTORY)
        shelf.prune(at)
    if (free := _free(at)) < need:
        raise DeployError(
            f"{at.releases}: {need / 1e6:.0f} MB are needed and {free / 1e6:.0f} MB free;"
            " delete recordings in /data/recordings"
        )


def _free(at: Places) -> int:
    found = os.statvfs(at.releases)
    return found.f_bavail * found.f_frsize


def _unpack(
    at: Places, part: Path, members: Iterator[Member], listed: Manifest, data: bytes
) -> None:
    """Writes all files of a release; those that the bundle leaves out are the card's own."""
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(0o755)
    held = [at.folder(name) for name in {at.linked("current"), FACTORY}]
    member = next(members, None)
    for file in listed.files:
        target = part / file.path
        target.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        if member is not None and member.name == file.path:
            _write(target, member.chunks(), file)
            member = next(members, None)
        else:
            _write(target, _from_card(held, file), file)
    if member is not None:
        raise DeployError(f"the bundle has {member.name[:80]!r}, which its list lacks there")
    release = manifest.load_release(part)
    if release != listed.release:
        raise DeployError(f"the bundle's {RELEASE} is not the one that its list tells")
    (part / MANIFEST).write_bytes(data)
    os.sync()  # one for all: each file's own costs the card a journal entry


def _compile(part: Path, folder: Path) -> None:
    """Byte code beside the sources: the firmware's user cannot write it, and a slow board would
    compile all of them at each start."""
    compileall.compile_dir(
        part,
        quiet=2,
        stripdir=str(part),
        prependdir=str(folder),
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    )
    os.sync()


def _write(target: Path, chunks: Iterator[bytes], file: File) -> None:
    digest, size = hashlib.sha256(), 0
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    with open(descriptor, "wb") as out:
        for chunk in chunks:
            size += len(chunk)
            if size > file.size:
                break
            digest.update(chunk)
            out.write(chunk)
    if size != file.size or digest.hexdigest() != file.sha256:
        raise DeployError(f"the bundle's {file.path} is not the file that its list tells")


def _from_card(held: list[Path], file: File) -> Iterator[bytes]:
    """A file that a release on the card has already; the caller checks its hash."""
    for folder in held:
        path = folder / file.path
        with contextlib.suppress(OSError):
            if path.stat().st_size == file.size and manifest.sha256_of(path) == file.sha256:
                with path.open("rb") as source:
                    while chunk := source.read(1 << 18):
                        yield chunk
                return
    raise DeployError(f"the bundle lacks {file.path}, and the card has none like it")


def holds(at: Places) -> dict[str, str]:
    """Path and SHA-256 of every file of the release in force: what a bundle may leave out."""
    current, _ = shelf.in_force(at)
    folder = at.folder(current)
    if current != FACTORY:
        found = places.read(folder / MANIFEST) or {}
        return {path: sha256 for path, _, sha256 in found["files"]}
    hashes = {}
    for path in folder.rglob("*"):
        relative = str(path.relative_to(folder))
        if path.is_file() and manifest.is_path(relative):
            hashes[relative] = manifest.sha256_of(path)
    return hashes
