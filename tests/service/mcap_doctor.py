"""Whether a recording is whole, as the mcap library reads it: straight through and by its index."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader


def complaints(path: Path) -> list[str]:
    """What is wrong with a recording; empty when nothing is."""
    data = path.read_bytes()
    try:
        straight = _told(NonSeekingReader(io.BytesIO(data), validate_crcs=True).iter_messages())
        begins, _, crc = struct.unpack("<QQI", data[-28:-8])  # the footer, before the last magic
        if zlib.crc32(data[begins:-12]) != crc:
            return ["its summary has another checksum"]
        reader = SeekingReader(io.BytesIO(data), validate_crcs=True)
        summary, indexed = reader.get_summary(), _told(reader.iter_messages())
        tables = list(reader.iter_metadata())
    except (McapError, EOFError, ValueError, OverflowError, struct.error) as error:
        return [repr(error)]
    if summary is None or summary.statistics is None:
        return ["it has no summary"]
    times, have = [time_ns for _, time_ns, _ in straight], summary.statistics
    told = {
        "its index finds other messages": indexed == straight,
        "its statistics are of others": (
            have.message_count, have.message_start_time, have.message_end_time,
            have.channel_count, have.chunk_count, have.metadata_count,
        ) == (
            len(straight), min(times, default=0), max(times, default=0),
            len(summary.channels), len(summary.chunk_indexes), len(tables),
        ),
    }  # fmt: skip
    return [complaint for complaint, holds in told.items() if not holds]


def _told(messages: Iterable[Any]) -> list[tuple[str, int, bytes]]:
    return sorted((channel.topic, one.log_time, one.data) for _, channel, one in messages)
