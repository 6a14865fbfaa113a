"""MCAP files from recipes: every length and checksum is right, unless the recipe says otherwise."""

from __future__ import annotations

import json
import struct
import zlib

import lz4.frame
import zstandard
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.opcode import Opcode
from pieces import Picker, blocks

from pi_firmware.wire import recording
from pi_firmware.wire.mcap_records import MAGIC
from readers import h264

TOPICS = (
    recording.VIDEO_TOPIC,
    recording.CALIBRATION_TOPIC,
    recording.TRUTH_TOPIC,
    recording.FRAME_INFO_TOPIC,
    recording.ESTIMATE_TOPIC,
    "/other",
)
_MOST_REPEATED, _MOST_BYTES = 200_000, 1 << 20
_RAW, _CHANNEL, _MESSAGE, _METADATA, _CHUNK, _END, _CLAIM, _REPEAT = range(8)


def build(data: bytes) -> bytes:
    """A file of the records that the recipe names; a first byte of 255 takes the rest as it is."""
    picker = Picker(data)
    if data[:1] == b"\xff":
        return data[1:]
    made = MAGIC + _records(picker, top=True)
    return made if picker.number(1) % 2 else made + MAGIC


def _records(picker: Picker, top: bool) -> bytes:
    made = bytearray()
    while picker.left() and len(made) < _MOST_BYTES:
        kind = picker.number(1) % 8
        if kind == _RAW:
            made += picker.block()
        elif kind == _CHANNEL:
            number = picker.number(1) % len(TOPICS)
            made += _record(Opcode.CHANNEL, _channel(number, picker.number(1) % 8))
        elif kind == _MESSAGE:
            head = struct.pack("<HIQQ", picker.number(1) % 8, 0, picker.number(5), 0)
            made += _record(Opcode.MESSAGE, head + picker.block())
        elif kind == _METADATA:
            content = _text(picker.of((b"camera", b"recording", b"")))
            made += _record(Opcode.METADATA, content + picker.block())
        elif kind == _CHUNK and top:
            made += _chunk(picker)
        elif kind == _END and top:
            made += _record(Opcode.DATA_END, struct.pack("<I", 0))
            made += _record(Opcode.FOOTER, struct.pack("<QQI", picker.number(2), 0, 0))
        elif kind == _CLAIM:  # a length that is not so
            made += struct.pack("<BQ", picker.number(1), picker.number(8)) + picker.block()
        elif kind == _REPEAT:
            piece = picker.block()
            made += piece * min(picker.number(3), _MOST_REPEATED // max(1, len(piece)))
    return bytes(made)


def _chunk(picker: Picker) -> bytes:
    how, inner = picker.number(1), _records(Picker(picker.block()), top=False)
    size, crc = len(inner), zlib.crc32(inner) if how & 1 else 0
    kind, packed = b"", inner
    if how & 6 == 2:
        kind, packed = b"zstd", zstandard.ZstdCompressor().compress(inner)
    elif how & 6 == 4:
        kind, packed = b"lz4", lz4.frame.compress(inner)
    if how & 8:
        size = picker.number(8)
    if how & 16:
        packed = picker.block()
    if how & 32:
        kind = picker.bytes(4)
    head = struct.pack("<QQQI", picker.number(5), picker.number(5), size, crc)
    return _record(Opcode.CHUNK, head + _text(kind) + struct.pack("<Q", len(packed)) + packed)


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _channel(topic: int, number: int) -> bytes:
    return (
        struct.pack("<HH", number, 0) + _text(TOPICS[topic].encode()) + _text(b"json") + _text(b"")
    )


def _text(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def channel(number: int) -> bytes:
    """The recipe of a channel whose id is its topic's number."""
    return bytes([_CHANNEL, number, number])


def message(number: int, time_ns: int, content: bytes) -> bytes:
    """The recipe of a message on the channel of that number."""
    return bytes([_MESSAGE, number]) + time_ns.to_bytes(5, "little") + blocks(content)


def chunk(how: int, *inner: bytes) -> bytes:
    """The recipe of a chunk: bit 0 with checksum, 2 zstd, 4 lz4."""
    return bytes([_CHUNK, how]) + blocks(b"".join(inner)) + bytes(10)


def seeds() -> list[bytes]:
    """A small flight as it is recorded, cut, compressed, and claims that are not so."""
    video, poses = [], []
    for number, data in enumerate(h264.access_units()):
        sample = CompressedVideo(data=data, format="h264")
        sample.timestamp.FromNanoseconds(1000 * number)
        video.append(message(0, 1000 * number, sample.SerializeToString()))
        pose = PoseInFrame()
        pose.timestamp.FromNanoseconds(1000 * number)
        pose.pose.orientation.w = 1.0
        poses.append(message(2, 1000 * number, pose.SerializeToString()))
    camera = CameraCalibration(width=64, height=48, distortion_model="plumb_bob", D=[0.1] * 5)
    camera.K[:] = [60, 0, 32, 0, 60, 24, 0, 0, 1]
    calibration = message(1, 0, camera.SerializeToString())
    told = message(3, 0, json.dumps({"sequence": 1, "exposure_s": 0.01}).encode())
    metadata = _text(b"readout_s") + _text(b"0.02")
    table = bytes([_METADATA, 0]) + blocks(struct.pack("<I", len(metadata)) + metadata)
    channels = b"".join(map(channel, range(5)))
    flight = [channels, calibration, *video, *poses, told]
    end = bytes([_END, 0, 0])
    deep = message(3, 0, b"[" * 3000)
    return [
        table + chunk(1, *flight) + end,
        table + chunk(3, *flight) + end,
        chunk(5, *flight),
        b"".join(flight) + table + end + b"\1",
        channels + chunk(1, deep) + end,
        bytes([_CHUNK, 10]) + blocks(b"") + (2**30 - 2).to_bytes(8, "little") + bytes(10) + end,
        bytes([_CHUNK, 12]) + blocks(b"") + (2**30 - 2).to_bytes(8, "little") + bytes(10) + end,
        chunk(2, bytes([_REPEAT]) + blocks(b"\0" * 255) + b"\xff\xff\x0f") + end,
        bytes([_CLAIM, 6]) + (2**62).to_bytes(8, "little") + blocks(b"abc"),
        b"\xff" + MAGIC,
    ]
