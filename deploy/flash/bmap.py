"""Block maps (`.bmap`): which blocks of an image mean something, each range with its checksum.

The format of bmap-tools, https://github.com/yoctoproject/bmaptool. Its `bmaptool copy` is not used
for writing: it checks the image as it reads it, and never reads back what it wrote.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

from deploy.errors import DeployError

CHUNK_BYTES = 4 << 20
_MAX_FILE_BYTES = 64 << 20
_MAX_BLOCK_BYTES = 1 << 20
_TEXT_OF = {"ImageSize", "BlockSize", "BlocksCount", "ChecksumType", "BmapFileChecksum", "Range"}
_RANGE = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)


@dataclass(frozen=True)
class Stretch:
    """Bytes `start` to `stop` (without it) of an image; `sha256` of them, "" where not known."""

    start: int
    stop: int
    sha256: str = ""


def read(path: Path, image_bytes: int) -> list[Stretch]:
    """The stretches that a block map names, in order; raises `DeployError` with one line."""
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise DeployError(f"{path}: {size} bytes; allowed: {_MAX_FILE_BYTES}")
        data = path.read_bytes()
    except OSError as error:
        raise DeployError(f"{path}: {error.strerror or error}") from None
    try:
        return _stretches(_Reader(data), data, image_bytes)
    except (expat.ExpatError, ValueError) as error:
        raise DeployError(f"{path}: not a block map: {' '.join(str(error).split())}") from None


def verify(file: BinaryIO, stretches: list[Stretch]) -> int | None:
    """Whether an image is the map's: its first byte that is not as the map says, or None.

    A map of another build leaves blocks out that matter, so what it leaves out must be zeros.
    """
    position = 0
    size = file.seek(0, os.SEEK_END)
    for stretch in [*stretches, Stretch(size, size)]:
        for start, data in chunks(file, Stretch(position, stretch.start), sparse=True):
            if data.count(0) != len(data):
                return start
        whole = hashlib.sha256()
        for _, data in chunks(file, stretch):
            whole.update(data)
        if stretch.sha256 and whole.hexdigest() != stretch.sha256:
            return stretch.start
        position = stretch.stop
    return None


def chunks(
    file: BinaryIO, stretch: Stretch, *, sparse: bool = False
) -> Iterator[tuple[int, bytes]]:
    """Offset and bytes of a stretch, piece by piece; `sparse` leaves a file's holes out."""
    position = stretch.start
    while position < stretch.stop:
        if sparse:
            try:
                position = os.lseek(file.fileno(), position, os.SEEK_DATA)
            except OSError:  # ENXIO: nothing but a hole up to the end
                return
            if position >= stretch.stop:
                return
        data = os.pread(file.fileno(), min(CHUNK_BYTES, stretch.stop - position), position)
        if not data:
            raise DeployError(f"the image ends at byte {position}: it was cut meanwhile")
        yield position, data
        position += len(data)


class _Reader:
    """Collects the few elements of a map; a document type, where entities are made, is refused."""

    def __init__(self, data: bytes) -> None:
        self.values: dict[str, str] = {}
        self.ranges: list[tuple[str, str]] = []
        self.version = ""
        self._depth = 0
        self._text: list[str] = []
        self._sum = ""
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._refuse
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text.append
        parser.Parse(data, True)

    def _refuse(self, *_: object) -> None:
        raise ValueError("it declares a document type")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > 3 or (self._depth == 1 and name != "bmap"):
            raise ValueError(f"<{name[:30]}> is not expected there")
        if self._depth == 1:
            self.version = attributes.get("version", "")
        self._text.clear()
        self._sum = attributes.get("chksum", "").lower()

    def _end(self, name: str) -> None:
        self._depth -= 1
        text = "".join(self._text).strip()
        self._text.clear()
        if name == "Range":
            self.ranges.append((text, self._sum))
        elif name in _TEXT_OF:
            if name in self.values:
                raise ValueError(f"<{name}> stands there twice")
            self.values[name] = text


def _stretches(read: _Reader, data: bytes, image_bytes: int) -> list[Stretch]:
    if not read.version.startswith("2."):
        raise ValueError(f"version {read.version[:20]!r}; expected 2.0")
    if read.values.get("ChecksumType") != "sha256":
        raise ValueError("its checksums are not sha256")
    own = read.values.get("BmapFileChecksum", "")
    # The map's own checksum is made over the file with zeros in the checksum's place.
    blank = data.replace(own.encode(), b"0" * len(own), 1)
    if not _SHA256.fullmatch(own) or hashlib.sha256(blank).hexdigest() != own:
        raise ValueError("its own checksum is wrong: it is cut or damaged")
    size, block = _number(read, "ImageSize"), _number(read, "BlockSize")
    if size != image_bytes:
        raise ValueError(f"it is of an image of {size} bytes, and this one has {image_bytes}")
    if not 512 <= block <= _MAX_BLOCK_BYTES or block % 512:
        raise ValueError(f"BlockSize is {block}; allowed: multiples of 512 to {_MAX_BLOCK_BYTES}")
    stretches: list[Stretch] = []
    end = 0
    for text, checksum in read.ranges:
        match = _RANGE.fullmatch(text)
        if match is None or not _SHA256.fullmatch(checksum):
            raise ValueError(f"range {text[:40]!r} with checksum {checksum[:70]!r}")
        start, stop = int(match[1]) * block, (int(match[2] or match[1]) + 1) * block
        if start < end or stop <= start or stop >= size + block:
            raise ValueError(f"range {text!r} overlaps, is backwards or lies outside")
        end = stop
        stretches.append(Stretch(start, min(stop, size), checksum))
    if not stretches:
        raise ValueError("it names no block")
    return stretches


def _number(read: _Reader, name: str) -> int:
    text = read.values.get(name, "")
    if not re.fullmatch(r"\d{1,18}", text, re.ASCII):
        raise ValueError(f"<{name}> is {text[:30]!r}")
    return int(text)
