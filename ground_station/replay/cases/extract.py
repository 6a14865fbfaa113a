"""One payload's flight out of a recording of several, where a replay looks for it."""

from __future__ import annotations

from pathlib import Path

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError, Message

from ground_station.errors import InputError
from ground_station.recording.frames import CAMERA_TABLE
from pi_firmware.wire import files
from pi_firmware.wire.recording import (
    CALIBRATION_TOPIC,
    ESTIMATE_TOPIC,
    FRAME_INFO_TOPIC,
    TRUTH_TOPIC,
    VIDEO_TOPIC,
    RecordingReader,
    RecordingWriter,
)

_KINDS: dict[str, type[Message]] = {
    VIDEO_TOPIC: CompressedVideo,
    CALIBRATION_TOPIC: CameraCalibration,
    TRUTH_TOPIC: PoseInFrame,
    ESTIMATE_TOPIC: PoseInFrame,
}
_TABLES = (CAMERA_TABLE, "simulation")
_FRAME_SCHEMA = "blimp.Frame"


def extract(source: str | Path, prefix: str, path: str | Path) -> int:
    """Copies the video, camera and poses behind a payload's `prefix` to their own topics.

    Written beside and renamed; what a cut recording has is copied. Returns the number of frames.
    Raises `InputError` when there are none.
    """
    source, path = Path(source), Path(path)
    reader = RecordingReader(source)
    wanted = {prefix + topic: topic for topic in (*_KINDS, FRAME_INFO_TOPIC)}
    frames = 0
    try:
        with files.replacing(path) as part:
            with RecordingWriter(part) as writer:
                for channel, record in reader.messages(set(wanted)):
                    _copy(writer, wanted[channel.topic], record.log_time, record.data)
                    frames += wanted[channel.topic] == VIDEO_TOPIC
                for name in _TABLES:
                    if reader.metadata.get(name):
                        writer.write_metadata(name, reader.metadata[name])
            if not frames:
                raise InputError(f"{source}: no video on {prefix}{VIDEO_TOPIC}")
    except DecodeError:
        raise InputError(f"{source}: a message is not what its topic says") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    return frames


def _copy(writer: RecordingWriter, topic: str, log_ns: int, data: bytes) -> None:
    if topic == FRAME_INFO_TOPIC:
        writer.write_json_text(topic, log_ns, data, schema_name=_FRAME_SCHEMA)
    else:
        writer.write_protobuf(topic, log_ns, _KINDS[topic].FromString(data))
