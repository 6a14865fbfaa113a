"""Which stretches of a file matter: a card is written by these, the rest keeps what it had.

So a stretch of zeros that means something (a table of free inodes, an empty journal) must be
among them, although a file system's tools leave a hole for it in a file.
"""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, order=True)
class Range:
    """Bytes `start` to `stop`, without the last."""

    start: int
    stop: int


def data_ranges(path: Path) -> list[Range]:
    """The stretches of a file that are not holes."""
    ranges: list[Range] = []
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        position = 0
        while position < size:
            try:
                start = os.lseek(file.fileno(), position, os.SEEK_DATA)
            except OSError as error:
                if error.errno == errno.ENXIO:  # nothing but a hole up to the end
                    break
                raise
            position = os.lseek(file.fileno(), start, os.SEEK_HOLE)
            ranges.append(Range(start, position))
    return ranges


def merged(ranges: Iterable[Range], block: int, size: int) -> list[Range]:
    """The ranges in order, widened to whole blocks and joined where they touch."""
    result: list[Range] = []
    for item in sorted(ranges):
        start, stop = item.start // block * block, min(-(-item.stop // block) * block, size)
        if result and start <= result[-1].stop:
            result[-1] = Range(result[-1].start, max(stop, result[-1].stop))
        else:
            result.append(Range(start, stop))
    return result


def copy_into(source: Path, ranges: Iterable[Range], target: Path, offset: int) -> None:
    """Writes the source's ranges into another file, `offset` bytes on; zeros are written, too."""
    with open(target, "r+b") as writer:
        for item in ranges:
            writer.seek(offset + item.start)
            for chunk in _chunks(source, item):
                writer.write(chunk)


def cut_out(source: Path, item: Range, target: Path) -> None:
    """Writes a stretch of a file to a file of its own; blocks of zeros become holes."""
    with open(target, "wb") as writer:
        for chunk in _chunks(source, item):
            if chunk.count(0) == len(chunk):
                writer.seek(len(chunk), os.SEEK_CUR)
            else:
                writer.write(chunk)
        writer.truncate(item.stop - item.start)


def sha256(path: Path, item: Range | None = None) -> str:
    """The hash of a file, or of a stretch of it, in hex."""
    whole = hashlib.sha256()
    for chunk in _chunks(path, item or Range(0, path.stat().st_size)):
        whole.update(chunk)
    return whole.hexdigest()


def _chunks(path: Path, item: Range) -> Iterator[bytes]:
    """A stretch of a file piece by piece; it ends early where the file does."""
    with open(path, "rb") as file:
        file.seek(item.start)
        left = item.stop - item.start
        while left and (chunk := file.read(min(left, _CHUNK_BYTES))):
            left -= len(chunk)
            yield chunk
