"""The records of an MCAP file, read so that no byte in it can hurt: cut, flipped or hostile.

Follows the MCAP specification, format version 0. The parsers of the single records are the mcap
library's; its own stream reader believes every length and skips what it does not know.
"""

from __future__ import annotations

import dataclasses
import io
import struct
import zlib
from collections.abc import Iterator
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Metadata
from mcap.stream_reader import CRCValidationError, breakup_chunk

MAGIC = b"\x89MCAP0\r\n"


class Damage(Exception):
    """Where and why reading a file ends early, in words."""


CUT = "the file ends before its footer"
PARSE_ERRORS = (
    McapError,
    struct.error,
    ValueError,
    KeyError,
    MemoryError,
    StopIteration,
    RuntimeError,
    zstandard.ZstdError,
)
"""What the record parsers raise on bytes that are not what they claim to be."""

_CHUNK_HEAD_BYTES = 8 + 8 + 8 + 4
"""Start and end time, unpacked size, checksum."""

_SALVAGE_LIMIT_BYTES = 1 << 26
"""How much of a chunk without an end is looked through."""

_CHUNK_LIMIT_BYTES = 1 << 30
"""No sane writer's chunk unpacks to more; compressed ones could claim anything."""


def records(file: IO[bytes]) -> Iterator[Channel | Metadata | Message | Footer]:
    """The records that matter, in file order; raises `Damage` where the file is not whole.

    Follows the MCAP specification 0: records are opcode (1), length (8), content. A length is held
    against what the file still has before anything is read, so that it cannot ask for memory.
    """
    size = file.seek(0, io.SEEK_END)
    at = file.seek(len(MAGIC))
    crc = zlib.crc32(MAGIC)
    while size - at >= 9:
        head = file.read(9)
        opcode, length = struct.unpack("<BQ", head)
        if opcode == 0:
            raise Damage(f"damaged at byte {at}: no record starts here")
        if length > size - at - 9:
            if opcode == Opcode.CHUNK:
                yield from _whole_ones(file.read(min(size - at - 9, _SALVAGE_LIMIT_BYTES)))
            return
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
            reason = "a checksum is wrong" if isinstance(error, CRCValidationError) else "not MCAP"
            raise Damage(f"damaged at byte {at}: {reason}") from None
        crc = zlib.crc32(content, zlib.crc32(head, crc))
        at += 9 + length


def _parse_record(opcode: int, content: bytes) -> Iterator[Channel | Metadata | Message]:
    """One record of the data section as those inside it; none for what the reader does not use."""
    if opcode == Opcode.CHANNEL:
        yield Channel.read(_stream(content))
    elif opcode == Opcode.METADATA:
        yield Metadata.read(_stream(content))
    elif opcode == Opcode.MESSAGE:
        yield Message.read(_stream(content), len(content))
    elif opcode == Opcode.CHUNK:
        chunk = _unpacked(Chunk.read(_stream(content)))
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Channel | Message):
                yield record


def _whole_ones(content: bytes) -> Iterator[Channel | Metadata | Message]:
    """The whole records in the beginning of a chunk whose end is missing, if not compressed.

    Its checksum cannot be verified: it stands for bytes that are not there.
    """
    try:
        stream = _stream(content)
        stream.read(_CHUNK_HEAD_BYTES)
        if stream.read_prefixed_string() != "":
            return
        stream.read8()
        at = stream.count
        while len(content) - at >= 9:
            opcode, length = struct.unpack_from("<BQ", content, at)
            at += 9
            if length > len(content) - at:
                return
            if opcode in (Opcode.CHANNEL, Opcode.MESSAGE):
                yield from _parse_record(opcode, content[at : at + length])
            at += length
    except PARSE_ERRORS:
        return


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk without compression, at most as large as it claims; raises ValueError else."""
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
    return dataclasses.replace(chunk, data=data, compression="")
