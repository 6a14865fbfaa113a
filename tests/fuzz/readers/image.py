"""`ground_station.recording.folder`: image files, whose headers may claim anything."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
from pieces import Picker, refusing, scratch

from ground_station.errors import InputError
from ground_station.recording.folder import ImageFolder

_FOLDER = scratch("image") / "images"
_FOLDER.mkdir()
_FORMS = (".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm")


def png(width: int, height: int, rows: bytes, kind: int = 0) -> bytes:
    """A PNG with right checksums, whatever its rows hold; `kind` 0 is grey, 2 colour, 6 with it."""
    head = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    )


def fuzz(data: bytes) -> None:
    """A picture that is taken is grey and has a size that a map's may have."""
    picker = Picker(data)
    for old in _FOLDER.iterdir():
        old.unlink()
    path = _FOLDER / f"a{picker.of(_FORMS)}"
    if picker.number(1) % 2:
        width, height, kind = picker.number(3), picker.number(3), picker.of((0, 2, 4, 6, 3))
        path.write_bytes(png(width, height, picker.rest(), kind))
    else:
        path.write_bytes(picker.rest())
    with refusing(InputError):
        for frame in ImageFolder(_FOLDER):
            assert frame.image.ndim == 2 and frame.image.dtype == np.uint8


def seeds() -> list[bytes]:
    """One of each form, and headers that claim gigabytes."""
    picture = np.arange(64, dtype=np.uint8).reshape(8, 8)
    found = []
    for number, form in enumerate(_FORMS):
        done, data = cv2.imencode(form, picture)
        assert done
        found.append(bytes([number, 0]) + data.tobytes())
    for side in (20_000, 32_000, 60_000):
        claim = side.to_bytes(3, "little") * 2
        found += [b"\0\1" + claim + bytes([kind]) + bytes(200) for kind in (0, 1, 3)]
    found.append(b"\5\0P5\n30000 30000\n255\n" + bytes(10))
    return found
