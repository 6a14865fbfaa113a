"""Recordings of other stations: listed and read where they lie, piece by piece."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any, Literal, Protocol

from ground_station.errors import GroundStationError
from ground_station.service.fleet.messages import ROOT
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.telemetry import Session

PIECE_BYTES = 256 * 1024
_LISTED = 500
TIMEOUT_S = 6.0


class Shelf(Protocol):
    """A station's recordings."""

    def list(self) -> list[dict[str, Any]]: ...

    def size(self, name: str) -> int: ...

    def pieces(self, name: str, begin: int, end: int) -> Iterator[bytes]: ...


def ask(
    session: Session,
    own: str,
    station: str,
    name: str,
    request: Mapping[str, Any],
    timeout_s: float = TIMEOUT_S,
) -> bytes:
    """What a station answers at a name to the station `own`; empty without an answer in time."""
    body = json.dumps({"by": own, "request": request}).encode()
    with contextlib.suppress(Exception):  # Zenoh's, of a session that is being closed
        for reply in session.zenoh.get(
            f"{ROOT}/{station}/do/{name}", payload=body, timeout=timeout_s
        ):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
    return b""


class Elsewhere:
    """Another station's files as a `Shelf`; raises a `BlimpError` where it does not answer."""

    def __init__(self, ask: Callable[[Mapping[str, Any]], bytes], station: str) -> None:
        self._ask, self._station = ask, station

    def list(self) -> list[dict[str, Any]]:
        found = self._json({"do": "list"})
        return found if isinstance(found, list) else []

    def size(self, name: str) -> int:
        return int(self._json({"do": "size", "file": name}))

    def pieces(self, name: str, begin: int, end: int) -> Iterator[bytes]:
        while begin < end:
            piece = self._ask({"do": "read", "file": name, "begin": begin, "end": end})
            if not piece:
                raise GroundStationError(f"station '{self._station}' did not answer")
            begin += len(piece)
            yield piece

    def file(self, name: str) -> ElsewhereFile:
        """A file to open as one that lies here."""
        return ElsewhereFile(self, name)

    def _json(self, request: Mapping[str, Any]) -> Any:
        try:
            found = json.loads(self._ask(request))
        except ValueError:
            raise GroundStationError(f"station '{self._station}' did not answer") from None
        if found is None:
            raise GroundStationError(f"station '{self._station}' has no such file")
        return found


class ElsewhereFile:
    """A file of another station's, read there as it is sought; `open` raises as the shelf does."""

    def __init__(self, shelf: Elsewhere, name: str) -> None:
        self.name, self._shelf = name, shelf

    def __str__(self) -> str:
        return self.name

    def open(self, _: Literal["rb"], /) -> IO[bytes]:
        return io.BufferedReader(_Pieces(self._shelf, self.name), PIECE_BYTES)


class _Pieces(io.RawIOBase):
    def __init__(self, shelf: Elsewhere, name: str) -> None:
        self._shelf, self._name, self._at, self._size = shelf, name, 0, shelf.size(name)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        end = min(self._size, self._at + len(buffer))
        piece = next(self._shelf.pieces(self._name, self._at, end), b"")
        piece = piece[: end - self._at]
        buffer[: len(piece)] = piece
        self._at += len(piece)
        return len(piece)


def read(shelf: Shelf, request: Mapping[str, Any]) -> bytes:
    """What is asked of this station's recordings; JSON's null where there is no such one."""
    do, file = request.get("do"), str(request.get("file"))
    try:
        if do == "list":
            return json.dumps(shelf.list()[:_LISTED]).encode()
        if do == "size":
            return json.dumps(shelf.size(file)).encode()
        begin, end = int(request["begin"]), int(request["end"])
        return next(shelf.pieces(file, begin, min(end, begin + PIECE_BYTES)), b"")
    except (BlimpError, OSError):
        return b"null" if do != "read" else b""
