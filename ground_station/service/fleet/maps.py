"""The map of a station that is joined: fetched once, by its content, onto this station's shelf."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ground_station.errors import GroundStationError, InputError, MapError
from ground_station.map.folder import check_is_map, replacing
from ground_station.service.fleet.messages import SESSION, map_files, rules
from ground_station.service.fleet.shelf import PIECE_BYTES, Elsewhere, ask
from ground_station.service.settings import StationSettings
from pi_firmware.wire import credentials
from pi_firmware.wire.telemetry import open_session

MAP = "map"
"""Asked of a station as its recordings are: list, read."""
_FETCHED = re.compile(r".+-[0-9a-f]{8}")
_LEAST_FREE_BYTES = 256_000_000
_LOOK_S = 10.0
_Name = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}\Z")]


@dataclass(frozen=True)
class _File:
    map: _Name
    file: _Name
    size: Annotated[int, Meta(ge=0)]
    sha256: str


class MapFiles:
    """A map's own files as a `Shelf`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def list(self) -> list[dict[str, Any]]:
        name = self._folder.absolute().name
        return [
            asdict(_File(name, path.name, path.stat().st_size, _sha256(path)))
            for path in map_files(self._folder)
        ]

    def size(self, name: str) -> int:
        return self._path(name).stat().st_size

    def pieces(self, name: str, begin: int, end: int) -> Iterator[bytes]:
        with self._path(name).open("rb") as file:
            file.seek(begin)
            while piece := file.read(min(PIECE_BYTES, end - begin)):
                begin += len(piece)
                yield piece

    def _path(self, name: str) -> Path:
        for path in map_files(self._folder):
            if path.name == name:
                return path
        raise MapError(f"{self._folder}: has no file {name!r:.80}")


def fetched(settings: StationSettings) -> Path:
    """The map's folder: fetched now, fetched before and unchanged, or, unanswered, the last one.

    Says which on standard output. Raises a `BlimpError` with one line when there is none, and for
    a map that does not come whole.
    """
    shelf = Path(settings.map.shelf)
    held = credentials.load(settings.telemetry.certificates)
    session = open_session(
        connect=settings.fleet.join, certificates=held.folder, rules=rules(held), more=SESSION
    )
    try:
        until_s = time.monotonic() + _LOOK_S
        while time.monotonic() < until_s:
            for station in (name.partition(".")[2] for name in held.stations):
                theirs = Elsewhere(partial(ask, session, held.member, station, MAP), station)
                listed = None
                with contextlib.suppress(GroundStationError):  # it is not there, or not yet
                    listed = theirs.list()
                if listed is not None:
                    return _fetch(theirs, station, listed, shelf)
            time.sleep(0.2)
    finally:
        session.close()
    kept = [path for path in shelf.glob("*/map.toml") if _FETCHED.fullmatch(path.parent.name)]
    if kept:
        folder = max(kept, key=lambda path: path.stat().st_mtime).parent
        print(f"no station answered; the map that was fetched last: {folder}", flush=True)
        return folder
    raise InputError(
        f"--join: no station answered within {_LOOK_S:.0f} s, and no map is named; start that one"
        " first, or name its map with --map"
    )


def _fetch(theirs: Elsewhere, station: str, listed: Any, shelf: Path) -> Path:
    try:
        files = msgspec.convert(listed, Annotated[list[_File], Meta(min_length=1, max_length=32)])
    except msgspec.ValidationError as error:
        raise InputError(
            f"station '{station}' has no map that can be fetched ({error}); name one with --map"
        ) from None
    name, size = files[0].map, sum(file.size for file in files)
    content = hashlib.sha256(repr(files).encode()).hexdigest()[:8]
    folder = shelf / f"{name}-{content}"
    told = f"map '{name}' of station '{station}'"
    if (folder / "map.toml").is_file():
        print(f"{told} is here already: {folder}", flush=True)
        return folder
    with replacing(folder) as part:
        status = os.statvfs(part)
        if status.f_bavail * status.f_frsize < size + _LEAST_FREE_BYTES:
            raise InputError(f"{shelf}: no room for the {told} ({size / 1e6:.0f} MB)")
        for file in files:
            with (part / file.file).open("wb") as written:
                for piece in theirs.pieces(file.file, 0, file.size):
                    written.write(piece)
            if _sha256(part / file.file) != file.sha256:
                raise InputError(
                    f"{told}: {file.file} was changed there meanwhile; start this again"
                )
        check_is_map(part)
    print(f"{told} was fetched, {size / 1e6:.1f} MB: {folder}", flush=True)
    return folder


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
