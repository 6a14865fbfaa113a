"""The checks of a recording find what is wrong with it, and nothing in what is whole."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap_doctor import MAGIC, complaints

from pi_firmware.wire.recording import RecordingWriter

SAMPLE = Path(__file__).parents[2] / "maps" / "atrium" / "flight.mcap"


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap"
    with RecordingWriter(path, chunk_bytes=100) as writer:
        writer.write_metadata("payload", {"payload_id": "blimp-1"})
        for k in range(20):
            writer.write_json_text("/a", 10 + k, b'{"k": 1}', schema_name="a")
            writer.write_json_text("/b", 5 + k, b'{"k": 2}', schema_name="b")
    return path


def test_what_is_whole_has_no_complaint(recording: Path) -> None:
    assert complaints(recording) == [] and complaints(SAMPLE) == []


def at(data: bytes, opcode: int, which: int = 0) -> int:
    """Where the content of a record begins."""
    place, found = len(MAGIC), []
    while place < len(data) - len(MAGIC):
        code, length = struct.unpack_from("<BQ", data, place)
        if code == opcode:
            found.append(place + 9)
        place += 9 + length
    return found[which]


def plus_one(data: bytearray, place: int) -> None:
    data[place] = (data[place] + 1) % 256


@pytest.mark.parametrize(
    ("opcode", "offset", "expected"),
    [
        (Opcode.CHUNK, 0, "other times"),  # its start time
        (Opcode.CHUNK, 16, "another size"),
        (Opcode.CHUNK, 24, "another CRC"),
        (Opcode.MESSAGE_INDEX, 6, "points elsewhere"),  # the first log time
        (Opcode.CHUNK_INDEX, 0, "tells of another"),
        (Opcode.CHUNK_INDEX, 16, "no chunk at"),
        (Opcode.CHUNK_INDEX, 38, "lie elsewhere"),  # a message index's offset
        (Opcode.METADATA_INDEX, 8, "no metadata payload"),
        (Opcode.STATISTICS, 0, "message_count is 41, not 40"),
        (Opcode.STATISTICS, 8, "schema_count"),
        (Opcode.STATISTICS, 22, "chunk_count"),
        (Opcode.STATISTICS, 34, "message_end_time"),
        (Opcode.FOOTER, 0, "the summary begins elsewhere"),
        (Opcode.FOOTER, 16, "the checksum of the summary"),
    ],
)
def test_a_number_that_is_another_is_found(
    recording: Path, opcode: int, offset: int, expected: str
) -> None:
    data = bytearray(recording.read_bytes())
    plus_one(data, at(bytes(data), opcode) + offset)
    recording.write_bytes(data)
    assert any(expected in complaint for complaint in complaints(recording))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: data[:-1],
        lambda data: data[1:],
        lambda data: data[: len(data) // 2],
        lambda data: MAGIC,
        lambda data: MAGIC + MAGIC,
        lambda data: b"",
    ],
)
def test_a_file_without_its_ends_is_found(recording: Path, spoil: Callable[[bytes], bytes]) -> None:
    recording.write_bytes(spoil(recording.read_bytes()))
    assert complaints(recording)
