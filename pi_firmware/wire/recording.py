"""MCAP recordings that open in Foxglove and Rerun: video, calibration, poses, and JSON channels.

Chunked with CRCs, so that a recording cut by a lost battery is readable up to its last whole chunk.
Times are integer nanoseconds; a message's log time is its capture time.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, Protocol, TypeVar

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError, Message
from mcap.reader import SeekingReader
from mcap.records import Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from pi_firmware.wire.errors import RecordingError, os_errors_as
from pi_firmware.wire.mcap_records import CUT, MAGIC, PARSE_ERRORS, Clamped, Damage, records

M = TypeVar("M", bound=Message)
VIDEO_TOPIC = "/camera/video"
CALIBRATION_TOPIC = "/camera/calibration"
TRUTH_TOPIC = "/truth/pose"
ESTIMATE_TOPIC = "/estimate/pose"
_CAMERA_FRAME = "camera"
_ANY_OBJECT = b'{"type": "object"}'
FRAME_INFO_TOPIC = "/camera/frame"
"""JSON, one a frame: `sequence`, `exposure_s`, `gain`."""


@dataclass(frozen=True)
class VideoSample:
    """One access unit of H.264 (Annex B), captured at `time_ns`."""

    time_ns: int
    data: bytes


@dataclass(frozen=True)
class PoseSample:
    """`wTc` at `time_ns`: position in metres, quaternion x, y, z, w."""

    time_ns: int
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]


def _descriptor_set(message: type[Message]) -> bytes:
    """The FileDescriptorSet that MCAP wants as a protobuf schema, dependencies first."""
    collected: dict[str, FileDescriptor] = {}

    def visit(file: Any) -> None:
        for dependency in file.dependencies:
            visit(dependency)
        collected.setdefault(file.name, file)

    visit(message.DESCRIPTOR.file)
    result = FileDescriptorSet()
    for file in collected.values():
        file.CopyToProto(result.file.add())
    return result.SerializeToString()


class RecordingWriter:
    """Writes one recording; a context manager. Channels are registered at their first message.

    `chunk_bytes` bounds what a power cut can cost; `open_file` is for a caller that owns the file.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        chunk_bytes: int = 256 * 1024,
        open_file: Callable[[Path], IO[bytes]] | None = None,
    ) -> None:
        self.path = Path(path)
        with os_errors_as(self.path, RecordingError):
            self._file = (open_file or (lambda p: p.open("wb")))(self.path)
        # H.264 does not compress further; JSON and poses are small beside it.
        self._writer = Writer(
            self._file,
            chunk_size=chunk_bytes,
            compression=CompressionType.NONE,
            use_summary_offsets=False,  # it tells of groups that it has not
        )
        with os_errors_as(self.path, RecordingError):
            self._writer.start(library="blimp")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self._closed = False

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Writes index and footer; a second call does nothing."""
        if not self._closed:
            self._closed = True
            with os_errors_as(self.path, RecordingError), self._file:
                self._writer.finish()

    def flush(self) -> None:
        """Ends the chunk in progress and hands it to the file: a cut from here on costs none of it.

        It does not wait for the disk.
        """
        with os_errors_as(self.path, RecordingError):
            self._writer.flush()

    def write_video(
        self,
        time_ns: int,
        data: bytes,
        *,
        topic: str = VIDEO_TOPIC,
        log_ns: int | None = None,
    ) -> None:
        """Adds one H.264 access unit in Annex B form.

        `log_ns` is the log time where that is another clock's, as in a file of several cameras.
        """
        message = CompressedVideo(frame_id=_CAMERA_FRAME, data=data, format="h264")
        message.timestamp.FromNanoseconds(time_ns)
        self.write_protobuf(topic, time_ns if log_ns is None else log_ns, message)

    def write_calibration(
        self,
        time_ns: int,
        *,
        width_px: int,
        height_px: int,
        matrix: Sequence[float],
        distortion: Sequence[float],
        distortion_model: str = "plumb_bob",
        topic: str = CALIBRATION_TOPIC,
    ) -> None:
        """Adds the camera: `matrix` is K row by row (9), `distortion` k1, k2, p1, p2, k3.

        Of a fisheye, whose `distortion_model` is kannala_brandt, `distortion` is k1 to k4.
        """
        k = [float(value) for value in matrix]
        message = CameraCalibration(
            frame_id=_CAMERA_FRAME,
            width=width_px,
            height=height_px,
            distortion_model=distortion_model,
            D=[float(value) for value in distortion],
            K=k,
            R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            P=[k[0], k[1], k[2], 0, k[3], k[4], k[5], 0, k[6], k[7], k[8], 0],
        )
        message.timestamp.FromNanoseconds(time_ns)
        self.write_protobuf(topic, time_ns, message)

    def write_pose(
        self,
        time_ns: int,
        position_m: Sequence[float],
        quaternion_xyzw: Sequence[float],
        *,
        topic: str,
        frame_id: str = "world",
        log_ns: int | None = None,
    ) -> None:
        """Adds `wTc`: position in metres, quaternion x, y, z, w; `log_ns` as in `write_video`."""
        message = PoseInFrame(frame_id=frame_id)
        message.timestamp.FromNanoseconds(time_ns)
        position, orientation = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = map(float, position_m)
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, quaternion_xyzw)
        self.write_protobuf(topic, time_ns if log_ns is None else log_ns, message)

    def write_json(
        self, topic: str, time_ns: int, message: Mapping[str, Any], *, schema_name: str
    ) -> None:
        """Adds a JSON object; raises `RecordingError` for what JSON cannot say, such as NaN."""
        try:
            payload = json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{self.path}: a message on {topic} is not JSON: {error}"
            ) from None
        self.write_json_text(topic, time_ns, payload, schema_name=schema_name)

    def write_json_text(self, topic: str, time_ns: int, text: bytes, *, schema_name: str) -> None:
        """Adds a JSON object that is text already, as telemetry's are; it is not parsed."""
        if topic not in self._channels:
            schema_id = self._schema(schema_name, "jsonschema", _ANY_OBJECT)
            self._channels[topic] = self._writer.register_channel(topic, "json", schema_id)
        self._add(topic, time_ns, text)

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds a named table of strings about the recording: seed, scene, program version."""
        with os_errors_as(self.path, RecordingError):
            self._writer.add_metadata(name, dict(values))

    def write_protobuf(self, topic: str, time_ns: int, message: Message) -> None:
        """Adds a message as it is, at its log time."""
        if topic not in self._channels:
            name = message.DESCRIPTOR.full_name
            schema_id = self._schema(name, "protobuf", _descriptor_set(type(message)))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema_id)
        self._add(topic, time_ns, message.SerializeToString())

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, encoding, data)
        return self._schemas[name]

    def _add(self, topic: str, time_ns: int, payload: bytes) -> None:
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        if not 0 <= time_ns < 1 << 63:
            raise RecordingError(f"{self.path}: the time {time_ns} ns is not between 0 and 2^63")
        with os_errors_as(self.path, RecordingError):
            self._writer.add_message(
                self._channels[topic],
                log_time=time_ns,
                publish_time=time_ns,
                data=payload,
                sequence=sequence & 0xFFFFFFFF,
            )


class Readable(Protocol):
    """Where a recording lies: a path, or whatever else opens as a file that can be sought in."""

    @property
    def name(self) -> str: ...

    def open(self, mode: Literal["rb"], /) -> IO[bytes]: ...


class RecordingReader:
    """Reads a recording in file order, whole or cut.

    After an iteration has come to its end, `cut` says whether the file stops before its footer or
    is damaged, and `cut_reason` where and why, in words. What was read before that is whole.
    """

    def __init__(self, path: str | Readable) -> None:
        self.path = Path(path) if isinstance(path, str) else path
        self.cut = False
        self.cut_reason = ""
        self.metadata: dict[str, dict[str, str]] = {}
        with os_errors_as(self.path, RecordingError), self.path.open("rb") as file:
            magic = file.read(8)
        if magic != MAGIC:
            raise RecordingError(
                f"{self.path}: no MCAP recording; blimp import makes one of a video"
            )

    def messages(self, topics: set[str] | None = None) -> Iterator[tuple[Channel, McapMessage]]:
        """All messages of `topics` (all topics when None), in file order, up to a cut."""
        channels: dict[int, Channel] = {}
        reason = CUT
        with self.path.open("rb") as file:
            try:
                for record in records(file):
                    if isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = dict(record.metadata)
                    elif isinstance(record, McapMessage):
                        channel = channels.get(record.channel_id)
                        if channel is not None and (topics is None or channel.topic in topics):
                            yield channel, record
                    else:
                        reason = ""
            except Damage as damage:
                reason = str(damage)
        self.cut, self.cut_reason = bool(reason), reason

    def message_count(self, topic: str) -> int | None:
        """The number of messages on `topic` by the recording's index, None when it has none."""
        summary = self.summary
        if summary is None or summary.statistics is None:
            return None
        counts = summary.statistics.channel_message_counts
        return sum(counts.get(c.id, 0) for c in summary.channels.values() if c.topic == topic)

    def metadata_table(self, name: str) -> dict[str, str]:
        """The metadata table of that name, wherever it stands in the file; empty when it is not."""
        summary = self.summary
        if name not in self.metadata and (
            summary is None or any(index.name == name for index in summary.metadata_indexes)
        ):
            for _ in self.messages(set()):
                pass
        return self.metadata.get(name, {})

    def since(
        self, from_ns: int, topics: set[str] | None = None
    ) -> Iterator[tuple[Channel, McapMessage]]:
        """The messages from a log time on, in the order of those times.

        One without an index, as after a cut, is read from its beginning and in file order.
        """
        if (summary := self.summary) is None:
            for channel, message in self.messages(topics):
                if message.log_time >= from_ns:
                    yield channel, message
            return
        with self.path.open("rb") as file:
            reader = SeekingReader(Clamped.of(file, _size(file)))
            reader._summary = summary  # of an hour's recording it takes a second to read
            try:
                for _, channel, message in reader.iter_messages(topics, start_time=from_ns):
                    yield channel, message
            except (*PARSE_ERRORS, OSError):
                self.cut, self.cut_reason = True, "it is damaged"

    @functools.cached_property
    def summary(self) -> Summary | None:
        """The index at the end of the file; None when it is cut off or damaged."""
        with self.path.open("rb") as file:
            try:
                size = _size(file)
                return SeekingReader(Clamped.of(file, size), record_size_limit=size).get_summary()
            except (*PARSE_ERRORS, OSError):
                return None

    def topics(self) -> dict[str, int]:
        """Every topic with its number of messages, counted by reading through the file."""
        counts: dict[str, int] = {}
        for channel, _ in self.messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
        return counts

    def video(self, topic: str = VIDEO_TOPIC) -> Iterator[VideoSample]:
        """The access units of `topic` in file order."""
        for _, record in self.messages({topic}):
            message = self._parse(CompressedVideo, record)
            if message.format != "h264":
                raise RecordingError(
                    f"{self.path}: video is {message.format[:40]!r}; only h264 is read"
                )
            yield VideoSample(message.timestamp.ToNanoseconds(), message.data)

    def calibration(self, topic: str = CALIBRATION_TOPIC) -> CameraCalibration | None:
        """The first calibration in the recording, or None."""
        for _, record in self.messages({topic}):
            return self._parse(CameraCalibration, record)
        return None

    def poses(self, topic: str) -> list[PoseSample]:
        result = []
        for _, record in self.messages({topic}):
            message = self._parse(PoseInFrame, record)
            p, q = message.pose.position, message.pose.orientation
            result.append(
                PoseSample(message.timestamp.ToNanoseconds(), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
            )
        return result

    def json(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        """The JSON objects of `topic` with their log times; raises when one is not an object."""
        for _, record in self.messages({topic}):
            try:
                value = json.loads(record.data, parse_constant=_refuse)
            except (ValueError, RecursionError):
                value = None
            if not isinstance(value, dict):
                raise RecordingError(f"{self.path}: a message on {topic} is not a JSON object")
            yield record.log_time, value

    def _parse(self, kind: type[M], record: McapMessage) -> M:
        try:
            return kind.FromString(record.data)
        except DecodeError:
            name = kind.DESCRIPTOR.full_name
            raise RecordingError(f"{self.path}: a message is not a {name}") from None


def _size(file: IO[bytes]) -> int:
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    return size


def _refuse(constant: str) -> None:
    """JSON has no NaN and no infinities, though Python's parser takes them."""
    raise ValueError(constant)
