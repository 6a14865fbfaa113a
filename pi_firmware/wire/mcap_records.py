"""The records of an MCAP file, read so that no byte in it can hurt: cut, flipped or hostile.

Follows the MCAP specification, format version 0. The parsers of the single records are the mcap
library's; its own stream reader believes every length and skips what it does not know.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import IO, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Metadata

MAGIC = b"\x89MCAP0\r\n"


Record = Channel | Metadata | Message


class _WrongChecksum(ValueError):
    """Of a chunk."""


class Damage(Exception):
    """Where and why reading a file ends early, in words."""


CUT = "the file ends before its footer"
PARSE_ERRORS = (
    McapError,
    struct.error,
    ValueError,
    KeyError,
    MemoryError,
    OverflowError,
    StopIteration,
    RuntimeError,
    zstandard.ZstdError,
)
"""What the record parsers raise on bytes that are not what they claim to be."""

_HEAD, _LENGTH = struct.Struct("<BQ"), struct.Struct("<Q")
_CHUNK_HEAD_BYTES = 8 + 8 + 8 + 4
"""Start and end time, unpacked size, checksum."""

_SALVAGE_LIMIT_BYTES = 1 << 26
"""How much of a chunk without an end is looked through."""

_CHUNK_LIMIT_BYTES = 1 << 27
"""No sane writer's chunk unpacks to more; compressed ones could claim anything."""

_USED = (Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE, Opcode.CHUNK)
_PIECE_BYTES = 1 << 20


def records(file: IO[bytes]) -> Iterator[Record | Footer]:
    """The records that matter, in file order; raises `Damage` where the file is not whole.

    Follows the MCAP specification 0: records are opcode (1), length (8), content. A length is held
    against what the file still has before anything is read, so that it cannot ask for memory.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - len(MAGIC)))
    ends_whole = file.read() == MAGIC
    at = file.seek(len(MAGIC))
    crc = zlib.crc32(MAGIC)
    while size - at >= 9:
        head = file.read(9)
        opcode, length = _HEAD.unpack(head)
        if opcode == 0:
            raise Damage(f"damaged at byte {at}: no record starts here")
        if length > size - at - 9:
            # A file with its closing magic was not cut: its length is wrong, and what follows may
            # be as well, with no checksum to tell.
            if ends_whole:
                raise Damage(f"damaged at byte {at}: a length is wrong")
            if opcode == Opcode.CHUNK:
                yield from _whole_ones(file.read(min(size - at - 9, _SALVAGE_LIMIT_BYTES)))
            return
        if opcode not in (*_USED, Opcode.DATA_END, Opcode.FOOTER):
            crc = zlib.crc32(head, crc)
            for size_left in range(length, 0, -_PIECE_BYTES):  # an attachment may be of any size
                crc = zlib.crc32(file.read(min(size_left, _PIECE_BYTES)), crc)
            at += 9 + length
            continue
        if length > _CHUNK_LIMIT_BYTES:
            raise Damage(f"damaged at byte {at}: a record of {length} bytes")
        content = file.read(length)
        try:
            if opcode == Opcode.DATA_END:
                expected = DataEnd.read(_stream(content)).data_section_crc
                if expected not in (0, crc):
                    raise Damage(f"damaged before byte {at}: the data's checksum is wrong")
            elif opcode == Opcode.FOOTER:
                yield Footer.read(_stream(content))
                return
            else:
                yield from _parse_record(opcode, content)
        except PARSE_ERRORS as error:
            reason = "a checksum is wrong" if isinstance(error, _WrongChecksum) else "not MCAP"
            raise Damage(f"damaged at byte {at}: {reason}") from None
        crc = zlib.crc32(content, zlib.crc32(head, crc))
        at += 9 + length


def _parse_record(opcode: int, content: bytes) -> Iterator[Record]:
    """One record of the data section as those inside it; none for what the reader does not use."""
    if opcode == Opcode.CHANNEL:
        yield Channel.read(_stream(content))
    elif opcode == Opcode.METADATA:
        yield Metadata.read(_stream(content))
    elif opcode == Opcode.MESSAGE:
        yield Message.read(_stream(content), len(content))
    elif opcode == Opcode.CHUNK:
        chunk = Chunk.read(_stream(content))
        data = _unpacked(chunk)
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise _WrongChecksum
        if _end_of_whole_ones(data, 0) != len(data):
            raise ValueError("the chunk's last record is not whole")
        yield from _inside(data, 0)


def _whole_ones(content: bytes) -> Iterator[Record]:
    """The whole records in the beginning of a chunk whose end is missing, if not compressed.

    Its checksum cannot be verified: it stands for bytes that are not there.
    """
    try:
        stream = _stream(content)
        stream.read(_CHUNK_HEAD_BYTES)
        if stream.read_prefixed_string() != "":
            return
        stream.read8()
        yield from _inside(content, stream.count)
    except PARSE_ERRORS:
        return


def _inside(content: bytes, at: int) -> Iterator[Record]:
    """The whole records of a chunk's content from byte `at` on.

    One after the other: those of nothing but small ones would take many times the chunk's size.
    """
    end = _end_of_whole_ones(content, at)
    while at < end:
        opcode, length = _HEAD.unpack_from(content, at)
        if opcode in (Opcode.CHANNEL, Opcode.MESSAGE):
            yield from _parse_record(opcode, content[at + 9 : at + 9 + length])
        at += 9 + length


def _end_of_whole_ones(content: bytes, at: int) -> int:
    """Where the last whole record of a chunk's content ends."""
    while len(content) - at >= 9:
        (length,) = _LENGTH.unpack_from(content, at + 1)
        if length > len(content) - at - 9:
            break
        at += 9 + length
    return at


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _unpacked(chunk: Chunk) -> bytes:
    """The chunk's content without compression; raises ValueError when not as long as claimed."""
    claimed = chunk.uncompressed_size
    if claimed > _CHUNK_LIMIT_BYTES:
        raise ValueError("the chunk claims an absurd size")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(claimed + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=claimed + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(data) != claimed:
        raise ValueError("the chunk is not as long as it claims")
    return bytes(data)


class Clamped:
    """A file that is asked for no more than it has: what is asked for is set aside at once.

    A length inside a record may claim four gigabytes. Not one of io's classes, which the reader of
    MCAP would put a buffer before that asks as it was asked.
    """

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._size = file, size
        self.seek, self.tell = file.seek, file.tell

    @classmethod
    def of(cls, file: IO[bytes], size: int) -> IO[bytes]:
        """The file, clamped; as the type that readers of MCAP are declared to take."""
        return cast(IO[bytes], cls(file, size))

    def read(self, size: int = -1) -> bytes:
        """At most what is left."""
        left = max(0, self._size - self._file.tell())
        return self._file.read(left if size < 0 else min(size, left))
