"""The check of recordings finds what is wrong with one, and nothing in what is whole."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from mcap_doctor import complaints

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


def test_another_byte_in_a_message_or_in_the_summary_is_found(recording: Path) -> None:
    data = recording.read_bytes()
    (begins,) = struct.unpack("<Q", data[-28:-20])
    for place in [data.index(b'"k": 2'), *range(begins, len(data) - 8, 25)]:
        recording.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert complaints(recording), place


def test_a_file_that_is_cut_is_found(recording: Path) -> None:
    data = recording.read_bytes()
    for cut in (data[:-1], data[1:], data[: len(data) // 2], data[:8], b""):
        recording.write_bytes(cut)
        assert complaints(recording), len(cut)
