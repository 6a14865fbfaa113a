"""`ground_station.map.colmap`: a COLMAP model's binary files, read by a library in C++."""

from __future__ import annotations

import functools
import shutil

import two_images
from pieces import Picker, blocks, refusing, scratch

from ground_station.errors import MapError
from ground_station.map import colmap

_FOLDER = scratch("colmap") / "sparse"
_SPARE = scratch("colmap-seed")


@functools.cache
def _files() -> dict[str, bytes]:
    """A small model as it is written."""
    two_images.write(_SPARE)
    return {path.name: path.read_bytes() for path in sorted(_SPARE.iterdir())}


def fuzz(data: bytes) -> None:
    """Each file is the seed's with pieces of it written over, cut, or another altogether."""
    picker = Picker(data)
    shutil.rmtree(_FOLDER, ignore_errors=True)
    _FOLDER.mkdir()
    for name, whole in _files().items():
        how = picker.number(1)
        content = bytearray(whole)
        if how & 1:
            for _ in range(1 + picker.number(1) % 4):
                at, piece = picker.number(2) % (len(whole) + 1), picker.bytes(picker.number(1) % 16)
                content[at : at + len(piece)] = piece
        if how & 2:
            del content[picker.number(2) % (len(content) + 1) :]
        if how & 4:
            content += picker.block()
        if how & 8 == 0 or how & 16 == 0:
            (_FOLDER / name).write_bytes(bytes(content))
    with refusing(MapError):
        model = colmap.read(_FOLDER)
        arrays = colmap.to_arrays(model)
        assert len(arrays.wTc) == len(arrays.names)


def seeds() -> list[bytes]:
    """The model as it is; one with each count changed."""
    names = list(_files())
    found = [b""]
    for number in range(len(names)):
        found.append(bytes(number) + b"\1\0\0\0\x08" + b"\xff" * 7 + b"\x3f")
        found.append(bytes(number) + b"\2\x14\0")
        found.append(bytes(number) + b"\4" + blocks(b"abc"))
    return found
