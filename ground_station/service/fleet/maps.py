"""Maps of other stations, fetched once, by their content: that of one joined, or one that grew."""

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
from ground_station.map import store
from ground_station.map.folder import check_is_map, content_id, files_flown_in, replacing
from ground_station.service.fleet.messages import MAPS, RUNS, SESSION, WORD, MapMessage, rules
from ground_station.service.fleet.shelf import PIECE_BYTES, Elsewhere, ask
from ground_station.service.settings import MapSettings, StationSettings
from pi_firmware.wire import credentials
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.telemetry import open_session

MAP = "map"
"""Asked of a station as its recordings are: list, read."""
_KEPT = (".before", ".part", ".old")
"""How folders end that `map.folder` leaves beside a map."""
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
            for path in files_flown_in(self._folder)
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
        for path in files_flown_in(self._folder):
            if path.name == name:
                return path
        raise MapError(f"{self._folder}: has no file {name!r:.80}")


class OwnMaps:
    """The maps that a station gives to others: the one it flies in, and those grown on its shelf.

    Each is read again when it is another.
    """

    def __init__(self, settings: MapSettings) -> None:
        self._own, self._shelf = Path(settings.folder).resolve(), Path(settings.shelf)
        self._read: dict[Path, tuple[int, MapMessage]] = {}

    def messages(self) -> list[MapMessage]:
        """What is told of them, the station's own first."""
        grown: list[Path] = []
        with contextlib.suppress(OSError):
            grown = sorted(self._shelf.iterdir())
        found = [self._of(self._own) or MapMessage(self._own.name[:WORD], content_id(self._own))]
        for folder in grown:
            kept = folder.suffix.startswith(_KEPT)
            said = None if kept or folder.resolve() == self._own else self._of(folder)
            if said is not None and said.grown_from and len(found) < MAPS:
                found.append(said)
        return found

    def folder(self, name: str) -> Path:
        """Where one that was told of lies; "": the station's own. Raises `MapError` for others."""
        told = {said.name: at for at, (_, said) in [*self._read.items()]}
        if name and name not in told:
            raise MapError(f"there is no map {name[:64]!r} to give")
        return told[name] if name else self._own

    def _of(self, folder: Path) -> MapMessage | None:
        try:
            written_ns = (folder / "map.toml").stat().st_mtime_ns
            before = self._read.get(folder)
            if before is None or before[0] != written_ns:
                self._read[folder] = (written_ns, _said(folder))
        except (OSError, BlimpError):
            self._read.pop(folder, None)
            return None
        return self._read[folder][1]


def _said(folder: Path) -> MapMessage:
    """What is told of a map; raises a `BlimpError` where its map.toml cannot be read."""
    info = store.load_info(folder)
    coordinates = store.coordinates_id(folder, info)
    grown, landmarks = {}, 0
    for run in info.extensions[-RUNS:]:
        with contextlib.suppress(LookupError, TypeError, ValueError):  # of before it said of what
            had, landmarks = (int(count) for count in run["landmarks"])
            grown[str(run["of"])[:WORD]] = had
    return MapMessage(folder.name[:WORD], content_id(folder), coordinates, landmarks, grown)


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
                    return fetch(theirs, station, listed, shelf)
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


def fetch(theirs: Elsewhere, station: str, listed: Any, shelf: Path) -> Path:
    """Takes the map of these files, as `MapFiles` lists them; raises as `fetched` does."""
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
