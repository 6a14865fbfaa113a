"""What `mcap doctor` looks at in a recording, so that a test can without that program.

After the MCAP specification, format version 0: the order of records, checksums, every index and
offset against what lies there, and the statistics against what was counted.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
_TYPES: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK: records.Chunk,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.MESSAGE_INDEX: records.MessageIndex,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}


class _Doctor:
    """Goes through one file; `complaints` in the order in which they were found."""

    def __init__(self, data: bytes) -> None:
        self.complaints: list[str] = []
        self._data = data
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._messages: Counter[int] = Counter()
        self._times: list[int] = []
        self._chunks: dict[int, tuple[Any, int]] = {}
        self._index_records: dict[int, dict[int, int]] = {}
        self._metadata: dict[int, tuple[str, int]] = {}

    def examine(self) -> None:
        data = self._data
        self._expect(data.startswith(MAGIC), "no magic at the beginning")
        if not data.endswith(MAGIC) or len(data) < 2 * len(MAGIC):
            self._expect(False, "no magic at the end")
            return
        found = list(_walk(data, len(MAGIC), len(data) - len(MAGIC)))
        codes = [opcode for _, opcode, _ in found]
        self._expect(codes[:1] == [Opcode.HEADER], "the first record is no header")
        self._expect(codes[-1:] == [Opcode.FOOTER], "the last record is no footer")
        ends = codes.count(Opcode.DATA_END)
        self._expect(ends == 1, f"{ends} ends of the data")
        if self.complaints:
            return
        end = codes.index(Opcode.DATA_END)
        self._data_section(found[:end])
        at, _, content = found[end]
        self._checksum(_read(Opcode.DATA_END, content).data_section_crc, 0, at, "the data section")
        self._summary(found[end + 1 : -1], found[-1], at + 9 + len(content))

    def _data_section(self, found: list[tuple[int, int, bytes]]) -> None:
        chunk_at = -1
        for at, opcode, content in found:
            if opcode == Opcode.CHUNK:
                chunk_at = at
                self._chunk(at, content)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._message_index(chunk_at, at, _read(opcode, content))
            elif opcode == Opcode.METADATA:
                self._metadata[at] = (_read(opcode, content).name, 9 + len(content))
            else:
                self._plain(opcode, content)

    def _plain(self, opcode: int, content: bytes) -> int | None:
        """A schema, a channel or a message, whose log time it returns."""
        if opcode == Opcode.SCHEMA:
            one = _read(opcode, content)
            told = (one.name, one.encoding, one.data)
            self._expect(one.id != 0, "a schema has the id 0")
            self._expect(self._schemas.setdefault(one.id, told) == told, f"two schemas {one.id}")
        elif opcode == Opcode.CHANNEL:
            one = _read(opcode, content)
            about = (one.schema_id, one.topic, one.message_encoding)
            self._expect(self._channels.setdefault(one.id, about) == about, f"channels {one.id}")
            self._expect(one.schema_id in self._schemas, f"{one.topic} comes before its schema")
        elif opcode == Opcode.MESSAGE:
            one = records.Message.read(_stream(content), len(content))
            self._expect(one.channel_id in self._channels, "a message before its channel")
            self._messages[one.channel_id] += 1
            self._times.append(one.log_time)
            return int(one.log_time)
        return None

    def _chunk(self, at: int, content: bytes) -> None:
        chunk = _read(Opcode.CHUNK, content)
        self._expect(chunk.compression == "", f"the chunk at {at} is {chunk.compression}")
        data = chunk.data
        self._expect(len(data) == chunk.uncompressed_size, f"the chunk at {at} has another size")
        crc = chunk.uncompressed_crc
        self._expect(crc != 0 and crc == zlib.crc32(data), f"the chunk at {at} has another CRC")
        times = []
        for _, opcode, inside in _walk(data, 0, len(data)):
            if (time_ns := self._plain(opcode, inside)) is not None:
                times.append(time_ns)
        span = (chunk.message_start_time, chunk.message_end_time)
        self._expect(
            span == (min(times, default=0), max(times, default=0)),
            f"the chunk at {at} is of other times",
        )
        self._chunks[at] = (chunk, 9 + len(content))
        self._index_records[at] = {}

    def _message_index(self, chunk_at: int, at: int, index: Any) -> None:
        self._index_records[chunk_at][index.channel_id] = at
        data = self._chunks[chunk_at][0].data
        for log_time, offset in index.records:
            opcode, length = struct.unpack_from("<BQ", data, offset)
            message = records.Message.read(_stream(data[offset + 9 :]), length)
            self._expect(
                (opcode, message.channel_id, message.log_time)
                == (Opcode.MESSAGE, index.channel_id, log_time),
                f"the message index at {at} points elsewhere",
            )

    def _summary(
        self, found: list[tuple[int, int, bytes]], last: tuple[int, int, bytes], begins: int
    ) -> None:
        footer = _read(Opcode.FOOTER, last[2])
        self._expect(footer.summary_start == begins, "the summary begins elsewhere")
        self._checksum(footer.summary_crc, begins, last[0] + 9 + 8 + 8, "the summary")
        groups: dict[int, list[int]] = {}
        channels, schemas = dict(self._channels), dict(self._schemas)
        indexed: set[int] = set()
        for at, opcode, content in found:
            one = _read(opcode, content)
            if opcode == Opcode.CHUNK_INDEX:
                indexed.add(one.chunk_start_offset)
                self._chunk_index(one)
            elif opcode == Opcode.METADATA_INDEX:
                told = (one.name, one.length)
                self._expect(self._metadata.get(one.offset) == told, f"no metadata {one.name}")
            elif opcode == Opcode.STATISTICS:
                self._statistics(one)
            elif opcode == Opcode.SUMMARY_OFFSET:
                first, *_, end = groups.get(one.group_opcode, [0, 0])
                # The shipped sample also tells of groups that it has not, of no length.
                self._expect(
                    one.group_length == 0
                    or (one.group_start, one.group_length) == (first, end - first),
                    f"the summary's group {one.group_opcode} lies elsewhere",
                )
                continue
            else:
                self._plain(opcode, content)
            groups.setdefault(opcode, [at]).append(at + 9 + len(content))
        self._expect((channels, schemas) == (self._channels, self._schemas), "summed up otherwise")
        self._expect(indexed == set(self._chunks), "not every chunk has its index")
        self._expect(Opcode.STATISTICS in groups, "no statistics")
        counts = [len(groups.get(code, [0])) - 1 for code in (Opcode.SCHEMA, Opcode.CHANNEL)]
        self._expect(counts == [len(schemas), len(channels)], "not all is repeated in the summary")

    def _chunk_index(self, index: Any) -> None:
        at = index.chunk_start_offset
        chunk, length = self._chunks.get(at, (None, 0))
        if chunk is None:
            self._expect(False, f"no chunk at {at}")
            return
        told = (
            index.chunk_length, index.message_start_time, index.message_end_time,
            index.compression, index.compressed_size, index.uncompressed_size,
        )  # fmt: skip
        have = (
            length, chunk.message_start_time, chunk.message_end_time,
            chunk.compression, len(chunk.data), chunk.uncompressed_size,
        )  # fmt: skip
        self._expect(told == have, f"the index of the chunk at {at} tells of another")
        self._expect(
            index.message_index_offsets == self._index_records[at],
            f"the message indexes of the chunk at {at} lie elsewhere",
        )

    def _statistics(self, told: Any) -> None:
        have = {
            "message_count": sum(self._messages.values()),
            "schema_count": len(self._schemas),
            "channel_count": len(self._channels),
            "attachment_count": 0,
            "metadata_count": len(self._metadata),
            "chunk_count": len(self._chunks),
            "message_start_time": min(self._times, default=0),
            "message_end_time": max(self._times, default=0),
            "channel_message_counts": dict(self._messages),
        }
        for name, value in have.items():
            said = getattr(told, name)
            self._expect(said == value, f"the statistics' {name} is {said}, not {value}")

    def _checksum(self, crc: int, begin: int, end: int, what: str) -> None:
        # 0: the writer gives none, as ours of the data section, whose chunks have their own.
        self._expect(
            crc == 0 or crc == zlib.crc32(self._data[begin:end]), f"the checksum of {what}"
        )

    def _expect(self, holds: bool, complaint: str) -> None:
        if not holds:
            self.complaints.append(complaint)


def _walk(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Offset, opcode and content of the records between two bytes."""
    while at < end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield at, opcode, data[at + 9 : at + 9 + length]
        at += 9 + length


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def _read(opcode: int, content: bytes) -> Any:
    return _TYPES[opcode].read(_stream(content))


def complaints(path: Path) -> list[str]:
    """What is wrong with a recording; empty when nothing is."""
    doctor = _Doctor(path.read_bytes())
    doctor.examine()
    return doctor.complaints
