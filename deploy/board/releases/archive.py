"""Reads a bundle's tar as it arrives, and takes nothing but plain files.

POSIX ustar (IEEE 1003.1, pax utility): 512-byte headers, content filled up to the next multiple.
Python's own reader knows links, devices, sparse files and extended headers of any size; all of
these have no place in a bundle, so here whatever is not a plain file with a sum that fits ends it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

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
    total = sum(block[:148]) + 8 * ord(" ") + sum(block[156:])
    if _octal(block[148:156]) != total:
        raise DeployError("the bundle is damaged: a header's sum is wrong")
    name, prefix = _text(block[:100]), _text(block[345:500])
    path = f"{prefix}/{name}" if prefix else name
    if block[156:157] != b"0":
        raise DeployError(f"the bundle's {path[:80]!r} is no plain file")
    if mode := _octal(block[100:108]) & ~0o777:
        raise DeployError(f"the bundle's {path[:80]!r} has the mode bits {mode:o}")
    return path, _octal(block[124:136])


def _octal(field: bytes) -> int:
    digits = field.rstrip(b" \0")
    if not digits or not digits.isdigit() or b"8" in digits or b"9" in digits:
        raise DeployError("the bundle is damaged: a header's number is none")
    return int(digits, 8)


def _text(field: bytes) -> str:
    try:
        return field.split(b"\0", 1)[0].decode()
    except UnicodeDecodeError:
        raise DeployError("the bundle has a name that is not UTF-8") from None


def _exactly(stream: BinaryIO, size: int) -> bytes:
    parts = []
    while size:
        data = stream.read(size)
        if not data:
            raise DeployError(_CUT)
        parts.append(data)
        size -= len(data)
    return b"".join(parts)
