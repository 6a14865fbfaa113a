"""Recordings: as the mcap library reads them, and cut, damaged or hostile."""

from __future__ import annotations

import errno
import io
import json
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader, make_reader
from mcap.writer import CompressionType, Writer

from pi_firmware.wire.errors import RecordingError
from pi_firmware.wire.mcap_records import MAGIC
from pi_firmware.wire.recording import (
    CALIBRATION_TOPIC,
    ESTIMATE_TOPIC,
    FRAME_INFO_TOPIC,
    TRUTH_TOPIC,
    VIDEO_TOPIC,
    RecordingReader,
    RecordingWriter,
)

START_NS = 1_700_000_000_123_456_789
N = 30
fuzz = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
Content = list[tuple[str, int, bytes]]


def write_flight(path: Path, n: int = N, chunk_bytes: int = 2000) -> None:
    rng = np.random.default_rng(2)
    with RecordingWriter(path, chunk_bytes=chunk_bytes) as writer:
        writer.write_metadata("flight", {"seed": "7", "scene": "atrium"})
        writer.write_calibration(
            START_NS, width_px=640, height_px=480,
            matrix=[500, 0, 320, 0, 501, 240, 0, 0, 1], distortion=[0.1, 0.2, 0.3, 0.4, 0.5],
        )  # fmt: skip
        for k in range(n):
            t = START_NS + k
            writer.write_video(t, rng.bytes(300))
            writer.write_pose(t, [k, 0.5, -1], [0, 0, 0.6, 0.8], topic=TRUTH_TOPIC)
            writer.write_json(
                FRAME_INFO_TOPIC, t, {"sequence": k, "gain": 1.5}, schema_name="blimp.frame"
            )
        writer.write_pose(t, [0, 0, 0], [0, 0, 0, 1], topic=ESTIMATE_TOPIC)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    write_flight(path)
    return path


def content(path: Path) -> Content:
    """What our reader gives: topic, time, data."""
    return [(c.topic, m.log_time, m.data) for c, m in RecordingReader(path).messages()]


def scratch(flight: Path, data: bytes) -> Path:
    path = flight.with_name("scratch.mcap")
    path.write_bytes(data)
    return path


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(
    inner: bytes, *, compression: str = "", claimed: int | None = None, crc: int = 0
) -> bytes:
    size = len(inner) if claimed is None else claimed
    head = struct.pack("<QQQI", 0, 0, size, crc) + text(compression)
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(inner)) + inner)


CHANNEL = record(
    Opcode.CHANNEL, struct.pack("<HH", 1, 0) + text("/a") + text("json") + struct.pack("<I", 0)
)
MESSAGE = record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 5, 5) + b"{}")


@pytest.mark.parametrize("reader", [SeekingReader, NonSeekingReader])
def test_the_mcap_library_reads_the_same_content(flight: Path, reader: Callable[..., Any]) -> None:
    with flight.open("rb") as file:
        theirs = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader(file, validate_crcs=True).iter_messages()
        ]
    ours = content(flight)
    assert sorted(ours) == sorted(theirs) and len(ours) == 3 * N + 2


def test_index_counts_and_metadata_are_there_for_tools(flight: Path) -> None:
    with flight.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 3 * N + 2
        assert len(summary.chunk_indexes) > 5
        assert {m.name: m.metadata for m in reader.iter_metadata()} == {
            "flight": {"seed": "7", "scene": "atrium"}
        }


def test_schemas_in_the_file_are_enough_to_decode_the_messages(flight: Path) -> None:
    decoded: dict[str, Any] = {}
    with flight.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                assert schema.encoding == "jsonschema" and json.loads(schema.data)
                decoded.setdefault(channel.topic, json.loads(message.data))
                continue
            assert schema.encoding == "protobuf"
            pool = descriptor_pool.DescriptorPool()  # empty: nothing from our own imports
            for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(one)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            decoded.setdefault(channel.topic, kind.FromString(message.data))
    video, pose = decoded[VIDEO_TOPIC], decoded[TRUTH_TOPIC]
    assert video.format == "h264" and len(video.data) == 300
    assert video.timestamp.seconds * 10**9 + video.timestamp.nanos == START_NS
    assert (pose.pose.position.y, pose.pose.orientation.w) == (0.5, 0.8)
    assert decoded[CALIBRATION_TOPIC].distortion_model == "plumb_bob"
    assert decoded[FRAME_INFO_TOPIC] == {"sequence": 0, "gain": 1.5}


def test_what_is_written_is_read_back(flight: Path) -> None:
    reader = RecordingReader(flight)
    video = list(reader.video())
    assert [sample.time_ns for sample in video] == [START_NS + k for k in range(N)]
    poses = reader.poses(TRUTH_TOPIC)
    assert poses[3].position_m == (3, 0.5, -1) and poses[3].quaternion_xyzw == (0, 0, 0.6, 0.8)
    calibration = reader.calibration()
    assert calibration is not None and list(calibration.D) == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert [value["sequence"] for _, value in reader.json(FRAME_INFO_TOPIC)] == list(range(N))
    assert reader.topics()[VIDEO_TOPIC] == N and not reader.cut and reader.cut_reason == ""
    assert reader.metadata["flight"]["seed"] == "7"
    assert reader.metadata_table("flight")["scene"] == "atrium"
    assert reader.metadata_table("nothing") == {}
    assert reader.message_count(VIDEO_TOPIC) == N and reader.message_count("/nothing") == 0


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunking", [True, False])
def test_recordings_of_other_writers_are_read(
    tmp_path: Path, compression: CompressionType, chunking: bool
) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, use_chunking=chunking, chunk_size=300)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for k in range(50):
            writer.add_message(channel, k, json.dumps({"k": k}).encode(), k)
        writer.add_attachment(1, 1, "log", "text/plain", b"x" * 500)
        writer.finish()
    reader = RecordingReader(path)
    assert [value["k"] for _, value in reader.json("/a")] == list(range(50))
    assert not reader.cut


@fuzz
@given(st.data())
def test_a_cut_anywhere_costs_only_what_is_behind_it(flight: Path, data: st.DataObject) -> None:
    whole, full = flight.read_bytes(), content(flight)
    at = data.draw(st.integers(8, len(whole) - 1))
    path = scratch(flight, whole[:at])
    read = content(path)
    assert read == full[: len(read)]
    behind = sum(len(d) for _, _, d in full[: len(read)])
    assert at - behind < 0.75 * len(whole)  # records, schemas and the index, but no flight, lost
    reader = RecordingReader(path)
    list(reader.messages())
    footer_is_whole = at >= len(whole) - len(MAGIC)
    assert reader.cut is not footer_is_whole
    assert reader.cut == bool(reader.cut_reason)
    reader.metadata_table("flight")
    assert reader.message_count(VIDEO_TOPIC) in (None, N)


def test_a_cut_in_a_chunk_keeps_the_whole_messages_before_it(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    write_flight(path, chunk_bytes=1 << 20)  # all of it in one chunk
    full = content(path)
    path.write_bytes(path.read_bytes()[:9000])
    read = content(path)
    assert read == full[: len(read)] and len(read) > 30


@fuzz
@given(st.data())
def test_flipped_bytes_never_give_a_wrong_message(flight: Path, data: st.DataObject) -> None:
    """Two of them: a third could also hide that the file is whole, and so pass it off as cut."""
    whole, full = flight.read_bytes(), content(flight)
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 2))):
        at = data.draw(st.integers(8, len(whole) - 1))
        damaged[at] ^= data.draw(st.integers(1, 255))
    path = scratch(flight, bytes(damaged))
    read = content(path)
    positions = iter(full)
    assert all(message in positions for message in read)  # those of the flight, in order
    RecordingReader(path).metadata_table("flight")
    RecordingReader(path).message_count(VIDEO_TOPIC)


def test_a_wrong_length_in_a_whole_file_is_damage_and_no_cut(flight: Path) -> None:
    """It would else pass messages on unchecked, here one with a flipped byte."""
    damaged = bytearray(flight.read_bytes())
    at = 8
    while damaged[at] != Opcode.CHUNK:
        at += 9 + struct.unpack_from("<Q", damaged, at + 1)[0]
    damaged[at + 4] ^= 1  # the chunk's length, by 16 MB
    damaged[at + 600] ^= 1
    reader = RecordingReader(scratch(flight, bytes(damaged)))
    assert list(reader.messages()) == []
    assert reader.cut and "a length is wrong" in reader.cut_reason


ZEROS = 64 << 20
BOMBS: dict[str, Callable[[], bytes]] = {
    "record of 2^60 bytes": lambda: record(Opcode.CHUNK, b"x" * 50, 1 << 60),
    "record of 2^64 - 1 bytes": lambda: record(Opcode.MESSAGE, b"x" * 50, (1 << 64) - 1),
    "metadata of 4 GB": lambda: record(Opcode.METADATA, struct.pack("<I", 0xFFFFFFFF) + b"x"),
    "channel name of 4 GB": lambda: record(Opcode.CHANNEL, b"\1\0\0\0\xff\xff\xff\xff"),
    "message in a chunk": lambda: chunk(record(Opcode.MESSAGE, b"x" * 30, 1 << 60)),
    "schema in a chunk": lambda: chunk(record(Opcode.SCHEMA, b"\1\0\xff\xff\xff\xff", 1 << 40)),
    "chunk claims 2^60": lambda: chunk(b"x" * 20, claimed=1 << 60),
    "zstd bomb": lambda: chunk(zstandard.compress(bytes(ZEROS)), compression="zstd", claimed=1000),
    "lz4 bomb": lambda: chunk(lz4.frame.compress(bytes(ZEROS)), compression="lz4", claimed=1000),
    "zstd claims 1 GB": lambda: chunk(
        zstandard.compress(b"\0"), compression="zstd", claimed=1 << 30
    ),
    "unknown compression": lambda: chunk(b"x" * 20, compression="brotli"),
    "message too short": lambda: record(Opcode.MESSAGE, b"x" * 5),
}


@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS)
def test_hostile_sizes_ask_for_no_memory(tmp_path: Path, bomb: Callable[[], bytes]) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + CHANNEL + MESSAGE + bomb() + MESSAGE)
    tracemalloc.start()
    try:
        reader = RecordingReader(path)
        read = list(reader.messages())
        reader.message_count("/a")
        reader.metadata_table("x")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(read) >= 1 and reader.cut
    assert peak < 4 << 20


def test_an_attachment_of_any_size_is_passed_over_in_pieces(tmp_path: Path) -> None:
    path = tmp_path / "large.mcap"
    path.write_bytes(MAGIC + CHANNEL + record(Opcode.ATTACHMENT, bytes(40 << 20)) + MESSAGE)
    tracemalloc.start()
    try:
        assert len(list(RecordingReader(path).messages())) == 1
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_chunk_of_small_messages_is_not_held_as_objects(tmp_path: Path) -> None:
    inner = CHANNEL + MESSAGE * 20_000
    path = tmp_path / "small.mcap"
    path.write_bytes(
        MAGIC + chunk(zstandard.compress(inner), compression="zstd", claimed=len(inner))
    )
    tracemalloc.start()
    try:
        assert sum(1 for _ in RecordingReader(path).messages()) == 20_000
        assert tracemalloc.get_traced_memory()[1] < 4 * len(inner)
    finally:
        tracemalloc.stop()


def test_a_chunk_with_a_wrong_checksum_is_where_reading_ends(tmp_path: Path) -> None:
    inner = CHANNEL + MESSAGE
    good, bad = chunk(inner, crc=zlib.crc32(inner)), chunk(inner, crc=1)
    path = tmp_path / "crc.mcap"
    path.write_bytes(MAGIC + good + bad + good)
    reader = RecordingReader(path)
    assert len(list(reader.messages())) == 1
    assert reader.cut_reason == f"damaged at byte {8 + len(good)}: a checksum is wrong"


def test_a_wrong_checksum_of_the_data_is_told_after_all_was_read(tmp_path: Path) -> None:
    path = tmp_path / "crc.mcap"
    data = MAGIC + CHANNEL + MESSAGE
    footer = record(Opcode.FOOTER, bytes(20)) + MAGIC
    for crc, cut in ((zlib.crc32(data), False), (0, False), (1, True)):
        path.write_bytes(data + record(Opcode.DATA_END, struct.pack("<I", crc)) + footer)
        reader = RecordingReader(path)
        assert len(list(reader.messages())) == 1 and reader.cut is cut
    assert "checksum" in reader.cut_reason


def test_unknown_records_are_passed_over(flight: Path) -> None:
    whole = flight.read_bytes()
    unknown = record(0x7F, b"of a later version") + record(0x80, b"") + record(0xFF, b"private")
    path = scratch(flight, whole[:8] + unknown + whole[8:])
    assert content(path) == content(flight)


def test_a_tail_of_zeros_as_a_lost_battery_leaves_is_a_cut(flight: Path) -> None:
    whole = flight.read_bytes()
    path = scratch(flight, whole[: len(whole) // 2] + bytes(1 << 20))
    reader = RecordingReader(path)
    assert list(reader.messages()) and reader.cut and "damaged at byte" in reader.cut_reason


def test_a_recording_whose_writer_was_killed_is_read(tmp_path: Path) -> None:
    path, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    writer = RecordingWriter(path, chunk_bytes=1000)
    for k in range(50):
        writer.write_json("/a", k, {"k": k, "pad": "x" * 100}, schema_name="t")
    copy.write_bytes(path.read_bytes())  # the file as it is before close
    writer.close()
    reader = RecordingReader(copy)
    read = [value["k"] for _, value in reader.json("/a")]
    assert read == list(range(len(read))) and len(read) > 20
    assert reader.cut and reader.cut_reason == "the file ends before its footer"


def test_what_was_flushed_is_read_although_its_writer_was_killed(tmp_path: Path) -> None:
    path, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    with RecordingWriter(path, chunk_bytes=1 << 20) as writer:
        for k in range(10):
            writer.write_json("/a", k, {"k": k}, schema_name="t")
            if k % 3 == 0:
                writer.flush()
                writer.flush()  # nothing new: no empty chunk
            copy.write_bytes(path.read_bytes())
            assert [value["k"] for _, value in RecordingReader(copy).json("/a")] == list(
                range(k - k % 3 + 1)
            )
    reader = RecordingReader(path)
    assert reader.topics() == {"/a": 10} and not reader.cut
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None and len(summary.chunk_indexes) == 4


def test_text_that_is_json_already_is_kept_as_it_is(tmp_path: Path) -> None:
    path, said = tmp_path / "a.mcap", b'{"schema":"blimp.event/1.0", "x":1e3}'
    with RecordingWriter(path) as writer:
        writer.write_json_text("/a", 5, said, schema_name="blimp.event")
        writer.write_json("/a", 6, {"x": 2}, schema_name="blimp.event")
    reader = RecordingReader(path)
    assert [message.data for _, message in reader.messages()] == [said, b'{"x":2}']
    assert [value["x"] for _, value in reader.json("/a")] == [1000.0, 2]


def test_what_is_no_recording_is_refused_in_one_line(tmp_path: Path, flight: Path) -> None:
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "short.mcap").write_bytes(MAGIC[:5])
    (tmp_path / "magic.mcap").write_bytes(b"\x89MCAP1\r\n" + flight.read_bytes()[8:])
    (tmp_path / "folder.mcap").mkdir()
    for name in ("empty", "short", "magic", "folder", "missing"):
        with pytest.raises(RecordingError, match=rf"^[^\n]*{name}\.mcap: [^\n]+$"):
            RecordingReader(tmp_path / f"{name}.mcap")


def test_an_early_end_by_the_caller_is_no_cut(flight: Path) -> None:
    reader = RecordingReader(flight)
    next(iter(reader.video()))
    assert reader.calibration() is not None and not reader.cut


def test_what_json_cannot_say_is_refused_both_ways(tmp_path: Path) -> None:
    path = tmp_path / "j.mcap"
    with RecordingWriter(path) as writer:
        for bad in ({"x": float("nan")}, {"x": float("inf")}, {"x": b"bytes"}):
            with pytest.raises(RecordingError, match="a message on /a is not JSON"):
                writer.write_json("/a", 1, bad, schema_name="t")
        channel = writer._writer.register_channel("/b", "json", 0)
        for text_ in (b'{"x": NaN}', b"[1]", b"{", b"\xff", b"[" * 100_000):
            writer._writer.add_message(channel, 1, text_, 1)
    assert list(RecordingReader(path).json("/a")) == []
    kinds = [m.data for _, m in RecordingReader(path).messages({"/b"})]
    assert len(kinds) == 5
    for k, kind in enumerate(kinds):
        single = tmp_path / f"{k}.mcap"
        with RecordingWriter(single) as writer:
            channel = writer._writer.register_channel("/b", "json", 0)
            writer._writer.add_message(channel, 1, kind, 1)
        with pytest.raises(RecordingError, match="a message on /b is not a JSON object"):
            list(RecordingReader(single).json("/b"))


def test_bytes_that_are_not_the_message_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.mcap"
    with RecordingWriter(path) as writer:
        writer.write_json(TRUTH_TOPIC, 1, {"no": "protobuf"}, schema_name="t")
    with pytest.raises(RecordingError, match=r"a message is not a foxglove\.PoseInFrame"):
        RecordingReader(path).poses(TRUTH_TOPIC)


@pytest.mark.parametrize("time_ns", [-1, 1 << 63])
def test_an_impossible_time_is_refused(tmp_path: Path, time_ns: int) -> None:
    with (
        RecordingWriter(tmp_path / "t.mcap") as writer,
        pytest.raises(RecordingError, match="not between 0"),
    ):
        writer.write_json("/a", time_ns, {}, schema_name="t")


def test_a_place_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        RecordingWriter(tmp_path / "nowhere" / "a.mcap")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_told_in_one_line() -> None:
    writer = RecordingWriter("/dev/full", chunk_bytes=1000)
    with pytest.raises(RecordingError, match="/dev/full: No space left on device"):
        for k in range(100):
            writer.write_video(k, b"x" * 900)
    with pytest.raises(RecordingError):
        writer.close()
    writer.close()  # a second time: nothing


def test_a_disk_that_is_full_from_the_start_is_told_in_one_line(tmp_path: Path) -> None:
    class Full(io.BytesIO):
        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(RecordingError, match=r"a\.mcap: No space left on device"):
        RecordingWriter(tmp_path / "a.mcap", open_file=lambda path: Full())


def test_long_recordings_are_written_and_read_in_constant_memory(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    unit = np.random.default_rng(0).bytes(50_000)
    tracemalloc.start()
    try:
        with RecordingWriter(path) as writer:
            for k in range(600):
                writer.write_video(k, unit)
        assert sum(1 for _ in RecordingReader(path).video()) == 600
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert path.stat().st_size > 30_000_000 and peak < 6_000_000


def test_a_length_that_claims_gigabytes_is_no_index(flight: Path) -> None:
    damaged = bytearray(flight.read_bytes())
    at = 8 + 9  # magic; the header's opcode and length: its profile's length is next
    damaged[at : at + 4] = struct.pack("<I", 2**32 - 16)
    damaged[-28:-20] = struct.pack("<Q", 8)  # the footer's summary_start: at the header
    damaged[-12:-8] = bytes(4)  # and no checksum of it
    code = (
        "import sys, tracemalloc\n"
        "from pi_firmware.wire.recording import VIDEO_TOPIC, RecordingReader\n"
        "tracemalloc.start()\n"
        "print(RecordingReader(sys.argv[1]).message_count(VIDEO_TOPIC))\n"
        "print(tracemalloc.get_traced_memory()[1] < 50_000_000)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, scratch(flight, bytes(damaged))],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "None\nTrue\n"), done.stderr
