"""What an MP4 or MOV file says of itself by QuickTime's metadata keys, a track's included.

FFmpeg, and PyAV with it, gives the keys of the movie only; phones write those of the lens into the
track. Layout: Apple, QuickTime File Format, "Metadata" (atoms `meta`, `keys`, `ilst`, `data`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_MOST_BYTES = 64 << 20
"""Of the atom `moov`: an hour of video has a few megabytes."""
_DEPTH = {b"trak", b"udta"}
_UTF8 = 1
_SIGNED = {21, 65, 66, 67, 74}
_UNSIGNED = {22, 75, 76, 77, 78}
_FLOATS = {(23, 4): ">f", (24, 8): ">d"}


def metadata(path: Path) -> dict[str, str | int | float]:
    """The keys of movie and tracks with their values; empty for any other file."""
    try:
        with path.open("rb") as file:
            return dict(_keyed(_moov(file)))
    except (OSError, struct.error, ValueError):
        return {}


def _moov(file: BinaryIO) -> bytes:
    """What the atom `moov` holds; empty where there is none."""
    end = file.seek(0, 2)
    at = 0
    while at + 8 <= end:
        file.seek(at)
        size, kind = struct.unpack(">I4s", file.read(8))
        head = 8
        if size == 1:
            (size,), head = struct.unpack(">Q", file.read(8)), 16
        size = size or end - at
        if size < head:
            break
        if kind == b"moov":
            return file.read(min(size - head, _MOST_BYTES))
        at += size
    return b""


def _atoms(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the atoms that lie behind each other; ends where they are broken."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > len(data):
            return
        yield kind, data[at + 8 : at + size]
        at += size


def _keyed(data: bytes) -> Iterator[tuple[str, str | int | float]]:
    for kind, content in _atoms(data):
        if kind in _DEPTH:
            yield from _keyed(content)
        elif kind == b"meta":
            # Of ISO's form four bytes of version and flags come first, of Apple's none.
            inner = dict(_atoms(content)) or dict(_atoms(content[4:]))
            if b"keys" not in inner:
                inner = dict(_atoms(content[4:]))
            names = [name for _, name in _atoms(inner.get(b"keys", b"")[8:])]
            for number, item in _atoms(inner.get(b"ilst", b"")):
                k = int.from_bytes(number, "big") - 1
                value = _value(dict(_atoms(item)).get(b"data", b""))
                if 0 <= k < len(names) and value is not None:
                    yield names[k].decode("utf-8", "replace"), value


def _value(data: bytes) -> str | int | float | None:
    if len(data) < 8:
        return None
    form, raw = int.from_bytes(data[:4], "big"), data[8:]
    if form == _UTF8:
        return raw.decode("utf-8", "replace")
    if form in _SIGNED | _UNSIGNED:
        return int.from_bytes(raw, "big", signed=form in _SIGNED)
    if (form, len(raw)) in _FLOATS:
        return float(struct.unpack(_FLOATS[form, len(raw)], raw)[0])
    return None
