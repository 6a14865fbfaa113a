"""`ground_station.mapping.sfm.foreign`: COLMAP models of others, binary and text."""

from __future__ import annotations

import functools
import shutil

import numpy as np
import two_images
from pieces import Picker, blocks, refusing, scratch, stretch

from ground_station.errors import MapError
from ground_station.map import colmap
from ground_station.mapping.sfm import foreign

_FOLDER = scratch("foreign") / "model"
_SPARE = scratch("foreign-seed")


@functools.cache
def _files() -> dict[str, bytes]:
    """A small model as it is written, both ways."""
    two_images.write(_SPARE)
    colmap.reread(_SPARE).write_text(_SPARE)
    names = (
        f"{stem}.{kind}" for kind in ("bin", "txt") for stem in ("cameras", "images", "points3D")
    )
    return {name: (_SPARE / name).read_bytes() for name in names}


def fuzz(data: bytes) -> None:
    """Binary or text; each file is the seed's with pieces of it written over, cut, or another."""
    picker = Picker(data)
    shutil.rmtree(_FOLDER, ignore_errors=True)
    _FOLDER.mkdir()
    ending = picker.of((".bin", ".txt"))
    for name, whole in _files().items():
        if not name.endswith(ending):
            continue
        how = picker.number(1)
        content = bytearray(whole)
        if how & 1:
            for _ in range(1 + picker.number(1) % 4):
                at, piece = picker.number(2) % (len(whole) + 1), picker.bytes(picker.number(1) % 32)
                content[at : at + len(piece)] = piece
        if how & 2:
            del content[picker.number(2) % (len(content) + 1) :]
        if how & 4:
            content += picker.block()
        (_FOLDER / name).write_bytes(bytes(content))
    with refusing(MapError):
        model = foreign.read(_FOLDER)
        assert len(model.names) == len(model.wTc) == len(model.points)
        assert np.isfinite(model.wTc).all()


def seeds() -> list[bytes]:
    """The model as it is; counts that are wrong; words of a text that are none."""
    found = [b"", b"\1"]
    for number in range(3):
        binary, text = b"\0" + bytes(number), b"\1" + bytes(number)
        found.append(binary + b"\1\0\0\0\x08" + b"\xff" * 7 + b"\x3f")
        found.append(binary + b"\2\x14\0")
        found.append(text + b"\2\x40\0")
        found += [text + b"\4" + blocks(line) for line in (b"1 2 3\n", b"nan 1e999 -1\n", b"\xff")]
    found.append(stretch((1, b"\1\4\xff\xff"), (60_000, b"1 ")))
    return found
