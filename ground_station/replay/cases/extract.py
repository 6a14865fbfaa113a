"""One payload's flight out of a recording of several, where a replay looks for it."""

from __future__ import annotations

from pathlib import Path

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError

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

_TOPICS = (VIDEO_TOPIC, CALIBRATION_TOPIC, FRAME_INFO_TOPIC, TRUTH_TOPIC, ESTIMATE_TOPIC)
_TABLES = (CAMERA_TABLE, "simulation")
_FRAME_SCHEMA = "blimp.Frame"


def extract(source: str | Path, prefix: str, path: str | Path) -> int:
    """Copies the video, camera and poses behind a payload's `prefix` to their own topics.

    Written beside and renamed; what a cut recording has is copied. Returns the number of frames.
    Raises `InputError` when there are none.
    """
    source, path = Path(source), Path(path)
    reader = RecordingReader(source)
    wanted = {prefix + topic: topic for topic in _TOPICS}
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
    except (DecodeError, IndexError):
        raise InputError(f"{source}: a message is not what its topic says") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    return frames


def _copy(writer: RecordingWriter, topic: str, log_ns: int, data: bytes) -> None:
    if topic == FRAME_INFO_TOPIC:
        writer.write_json_text(topic, log_ns, data, schema_name=_FRAME_SCHEMA)
    elif topic == VIDEO_TOPIC:
        video = CompressedVideo.FromString(data)
        writer.write_video(video.timestamp.ToNanoseconds(), video.data, topic=topic, log_ns=log_ns)
    elif topic == CALIBRATION_TOPIC:
        camera = CameraCalibration.FromString(data)
        writer.write_calibration(
            log_ns,
            width_px=camera.width,
            height_px=camera.height,
            matrix=list(camera.K),
            distortion=list(camera.D),
            distortion_model=camera.distortion_model,
            topic=topic,
        )
    else:
        pose = PoseInFrame.FromString(data)
        p, q = pose.pose.position, pose.pose.orientation
        writer.write_pose(
            pose.timestamp.ToNanoseconds(),
            (p.x, p.y, p.z),
            (q.x, q.y, q.z, q.w),
            topic=topic,
            frame_id=pose.frame_id,
            log_ns=log_ns,
        )
