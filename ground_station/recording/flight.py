"""A flight recording (MCAP) as a source of frames, and the trajectories inside it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from ground_station.arrays import U8
from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.geometry.lens_models import MODELS
from ground_station.geometry.trajectory import Trajectory
from ground_station.recording.frames import (
    ALL_FRAMES,
    CAMERA_TABLE,
    Frame,
    FrameRange,
    plausible_exposure_s,
    write_calibration,
)
from ground_station.recording.h264 import Decoder, grey
from ground_station.recording.video import check_given, frame_name
from pi_firmware.wire import annexb, config, sei
from pi_firmware.wire.recording import (
    CALIBRATION_TOPIC,
    FRAME_INFO_TOPIC,
    TRUTH_TOPIC,
    VIDEO_TOPIC,
    RecordingReader,
    RecordingWriter,
    VideoSample,
)

_AHEAD = 64
"""Messages looked through for one frame's: writers put it within a chunk of the frame's video."""


class Exposures:
    """The exposures of a recording, read along with its video by a reader of its own.

    A frame's message is the one logged at its capture time; where it is missing or tells nothing
    plausible, the access unit's own SEI is asked. A message that is no JSON object tells nothing.
    """

    def __init__(self, path: Path) -> None:
        self._messages = self._read(RecordingReader(path))
        self._known: dict[int, float | None] = {}

    def of(self, sample: VideoSample) -> float | None:
        """The exposure of the picture in an access unit, seconds; None where nothing tells it."""
        for _ in range(_AHEAD):
            if sample.time_ns in self._known or (message := next(self._messages, None)) is None:
                break
            self._known[message[0]] = message[1]
        exposure_s = self._known.get(sample.time_ns)
        if exposure_s is None and (info := sei.find(sample.data)) is not None:
            exposure_s = plausible_exposure_s(info.exposure_s)
        return exposure_s

    @staticmethod
    def _read(reader: RecordingReader) -> Iterator[tuple[int, float | None]]:
        for _, record in reader.messages({FRAME_INFO_TOPIC}):
            try:
                message = json.loads(record.data)
            except (ValueError, RecursionError):
                message = None
            value = message.get("exposure_s") if isinstance(message, dict) else None
            yield record.log_time, plausible_exposure_s(value)


class FlightRecording:
    """The video of a recording; every frame keeps its access unit's capture time exactly.

    `camera` is the recording's calibration, with the readout time of its metadata when there.
    Frame k is the k-th access unit in the file, also where others before it cannot be decoded.
    """

    def __init__(self, path: Path, frame_range: FrameRange = ALL_FRAMES) -> None:
        self.path = path
        self.notes: list[str] = []
        self._range = frame_range
        self._reader = RecordingReader(path)
        self.camera: Camera | None = camera_of(self._reader)

    def count(self) -> int | None:
        total = self._reader.message_count(VIDEO_TOPIC)
        return None if total is None else self._range.count(total)

    def __iter__(self) -> Iterator[Frame]:
        self.notes.clear()
        reader, decoder = RecordingReader(self.path), Decoder()
        exposures = Exposures(self.path)
        given = 0
        for number, sample, picture in self._pictures(reader, decoder):
            if number in self._range:
                given += 1
                exposure_s = exposures.of(sample)
                yield self._frame(number, sample.time_ns, grey(picture), exposure_s)
        if reader.cut:
            self.notes.append(f"{self.path}: cut ({reader.cut_reason}); {given} frames read")
        if decoder.damaged:
            self.notes.append(f"{self.path}: {decoder.damaged} damaged frames left out")
        if reader.cut and not given:
            raise InputError(f"{self.path}: cut ({reader.cut_reason}); no whole frame before that")
        check_given(self.path, given, self._range)

    def _pictures(
        self, reader: RecordingReader, decoder: Decoder
    ) -> Iterator[tuple[int, VideoSample, av.VideoFrame]]:
        """Every picture up to the range's end with its access unit and that one's number."""
        samples: dict[int, VideoSample] = {}
        missing, is_empty = {annexb.NAL_SPS, annexb.NAL_PPS}, True
        for k, sample in enumerate(reader.video()):
            if self._range.is_past(k):
                break
            is_empty = False
            if missing:
                missing -= set(annexb.nal_types(sample.data))
            samples[k] = sample
            for number, picture in decoder.decode(sample.data, k):
                yield number, samples.pop(number), picture
        for number, picture in decoder.flush():
            yield number, samples.pop(number), picture
        if missing and not is_empty:
            raise InputError(f"{self.path}: its video carries no H.264 parameter sets (SPS/PPS)")

    def _frame(self, number: int, time_ns: int, image: U8, exposure_s: float | None) -> Frame:
        height, width = image.shape
        if self.camera and (width, height) != (self.camera.width_px, self.camera.height_px):
            raise InputError(
                f"{self.path}: its video has {width}x{height} px, its calibration "
                f"{self.camera.width_px}x{self.camera.height_px} px"
            )
        return Frame(number, frame_name(number), time_ns, image, exposure_s)


_LENS_MODELS = {
    "plumb_bob": "opencv5",
    "": "opencv5",
    "kannala_brandt": "fisheye",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Ours by `foxglove.CameraCalibration`'s names; the fisheye's last two are ROS's and OpenCV's."""


def camera_of(reader: RecordingReader) -> Camera | None:
    """The camera of a recording, None when it has none or one not calibrated (ROS: fx of 0).

    Raises `CameraError` or `ConfigError` for values out of range.
    """
    message = reader.calibration()
    if message is None or not message.K or message.K[0] == 0:
        return None
    d = list(message.D)
    model = _LENS_MODELS.get(message.distortion_model)
    names = MODELS[model].NAMES if model else ()
    enough = len(d) == len(names) if model == "fisheye" else len(d) <= len(names)
    if model is None or len(message.K) != 9 or not enough:
        raise InputError(
            f"{reader.path}: the lens model '{message.distortion_model}' with {len(d)} parameters; "
            "only plumb_bob with up to 5 and kannala_brandt with 4 are read"
        )
    text = reader.metadata_table(CAMERA_TABLE).get("readout_s", "0")
    try:
        readout_s = float(text)
    except ValueError:
        raise InputError(f"{reader.path}: readout_s is {text!r}, not a number") from None
    K = list(message.K)
    values = {
        "width_px": message.width,
        "height_px": message.height,
        **{"fx_px": K[0], "fy_px": K[4], "cx_px": K[2], "cy_px": K[5]},
        **dict(zip(names, d, strict=False)),
        "readout_s": readout_s,
        "model": model,
    }
    return config.from_mapping(values, Camera, where=f"{reader.path}: calibration")


def write_camera(writer: RecordingWriter, camera: Camera, time_ns: int) -> None:
    """Writes what `camera_of` reads: the calibration, and the camera's numbers as metadata."""
    writer.write_metadata(CAMERA_TABLE, {k: str(v) for k, v in camera.as_dict().items()})
    write_calibration(writer, camera, time_ns, CALIBRATION_TOPIC)


def trajectory_of(
    path: str | Path, topic: str = TRUTH_TOPIC, notes: list[str] | None = None
) -> Trajectory:
    """The poses on `topic` of a recording, sorted by time; a cut is said in `notes`.

    Raises `InputError` when there are none or a number is not finite.
    """
    reader = RecordingReader(path)
    samples = reader.poses(topic)
    if not samples:
        raise InputError(f"{path}: no poses on {topic}")
    if reader.cut and notes is not None:
        notes.append(f"{path}: cut ({reader.cut_reason}); {len(samples)} poses read")
    samples.sort(key=lambda sample: sample.time_ns)
    times = np.array([sample.time_ns for sample in samples], dtype=np.int64)
    positions = np.array([sample.position_m for sample in samples])
    quaternions = np.array([sample.quaternion_xyzw for sample in samples])
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (np.all(np.isfinite(positions)) and np.all(np.isfinite(norms)) and np.all(norms > 1e-6)):
        raise InputError(f"{path}: a pose on {topic} is not finite or has a zero quaternion")
    return Trajectory(times, positions, quaternions / norms)
