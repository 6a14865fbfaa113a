"""A recording in a size and at a rate that an emulated processor bears, made once of a larger one.

    python tests/hil/payloads/small.py FLIGHT.mcap SMALL.mcap

Capture times, true poses and what a frame's exposure was stay exact; pictures are averaged over
areas, and the camera is the same lens on a coarser grid.
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ground_station.errors import InputError
from ground_station.experiments.disturbances.scale import Scale
from ground_station.progress import Progress
from ground_station.recording.flight import FlightRecording, camera_of
from ground_station.recording.frames import CAMERA_TABLE
from ground_station.recording.h264 import H264Encoder
from pi_firmware.sources.schemes.replay import RateGrid
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.recording import TRUTH_TOPIC, RecordingReader, RecordingWriter

_VERSION = 1
"""Of what is made here: a cached file of another is not taken."""
_CRF = 18.0


@dataclass(frozen=True)
class Size:
    """What the emulated board bears: picture size, px, and frames a second."""

    width_px: int = 320
    height_px: int = 240
    rate_hz: float = 5.0


def small(recording: Path, folder: Path, size: Size = Size()) -> Path:
    """The recording in this size, from `folder` when it was made before.

    Raises `InputError` for one without a camera, or smaller than that.
    """
    with recording.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]
    name = f"{digest}-{size.width_px}x{size.height_px}-{size.rate_hz:g}Hz-{_VERSION}.mcap"
    path = folder / name
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        make(recording, part, size)
        part.replace(path)
    return path


def make(recording: Path, out: Path, size: Size = Size()) -> None:
    """Writes the recording in this size."""
    reader = RecordingReader(recording)
    camera = camera_of(reader)
    if camera is None:
        raise InputError(f"{recording}: it carries no camera calibration")
    # The same lens on a grid of fewer pixels.
    coarse = Scale(size.width_px / camera.width_px).camera(camera)
    if (coarse.width_px, coarse.height_px) != (size.width_px, size.height_px):
        raise InputError(
            f"{camera.width_px}x{camera.height_px} px do not become"
            f" {size.width_px}x{size.height_px}: the shape is another, or it is larger"
        )
    encoder = H264Encoder(size.width_px, size.height_px, size.rate_hz, crf=_CRF)
    grid, times = RateGrid(size.rate_hz), list[int]()
    with RecordingWriter(out) as writer, Progress("small recording", None) as progress:
        writer.write_metadata(CAMERA_TABLE, {"readout_s": f"{coarse.readout_s:g}"})
        for name in ("simulation",):
            if values := reader.metadata_table(name):
                writer.write_metadata(name, values)
        for frame in FlightRecording(recording):
            if not grid.takes(frame.time_ns):
                continue
            if not times:
                writer.write_calibration(
                    frame.time_ns,
                    width_px=size.width_px,
                    height_px=size.height_px,
                    matrix=coarse.matrix.ravel().tolist(),
                    distortion=coarse.distortion.tolist(),
                )
            times.append(frame.time_ns)
            picture = cv2.resize(
                frame.image, (size.width_px, size.height_px), interpolation=cv2.INTER_AREA
            )
            for k, unit in encoder.encode(np.repeat(picture[..., None], 3, axis=2)):
                writer.write_video(times[k], unit)
            progress.step()
        for k, unit in encoder.finish():
            writer.write_video(times[k], unit)
        taken = set(times)
        for pose in reader.poses(TRUTH_TOPIC) if TRUTH_TOPIC in reader.topics() else ():
            if pose.time_ns in taken:
                writer.write_pose(
                    pose.time_ns, pose.position_m, pose.quaternion_xyzw, topic=TRUTH_TOPIC
                )


if __name__ == "__main__":
    try:
        make(Path(sys.argv[1]), Path(sys.argv[2]))
    except BlimpError as error:
        print(f"small: {error}", file=sys.stderr)
        sys.exit(2)
