"""A plain video, or a folder of images, as a recording that can be replayed."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.geometry.resizing import misfit
from ground_station.recording.flight import write_camera
from ground_station.recording.frames import FrameSource
from ground_station.recording.h264 import H264Encoder
from pi_firmware.wire import files
from pi_firmware.wire.errors import os_errors_as
from pi_firmware.wire.recording import RecordingWriter

IDR_NS = 1_000_000_000
"""From IDR to IDR at most, as in every recording."""
_CRF = 18.0  # nothing to be seen is lost a second time


def import_frames(
    source: FrameSource,
    camera: Camera,
    path: str | Path,
    *,
    name: str,
    step: Callable[[], object] = lambda: None,
) -> int:
    """Writes the frames of the input `name` with its camera as a recording; gives how many.

    The frames keep their times; they are encoded again, without B-frames, grey. `step` is called
    after each. The recording is written beside and renamed. Raises `InputError` with one line for
    frames that are not of the camera's size, and for sides that are odd, which H.264 does not take.
    """
    width, height = camera.width_px, camera.height_px
    if width % 2 or height % 2:
        raise InputError(
            f"{name}: its pictures are {width}x{height}, and H.264 takes even sides only:"
            " scale or crop them"
        )
    frames = iter(source)
    first = next(frames, None)
    if first is None:
        raise InputError(f"{name}: it gives no video frames")
    encoder = H264Encoder(width, height, 30.0, crf=_CRF)
    times_ns: list[int] = []
    idr_ns = first.time_ns
    path = Path(path)
    with (
        os_errors_as(path, InputError),
        files.replacing(path) as part,
        RecordingWriter(part) as writer,
    ):
        write_camera(writer, camera, first.time_ns)
        writer.write_metadata("import", {"source": name})
        for frame in itertools.chain([first], frames):
            if frame.image.shape != (height, width):
                fit = misfit(camera, frame.image.shape[1], frame.image.shape[0])
                raise InputError(f"{name}: {frame.name} has {fit}")
            # Where the next one, after as long as this one, would come too late.
            is_idr = not times_ns or 2 * frame.time_ns - times_ns[-1] - idr_ns > IDR_NS
            idr_ns = frame.time_ns if is_idr else idr_ns
            times_ns.append(frame.time_ns)
            for index, data in encoder.encode(frame.image, idr=is_idr):
                writer.write_video(times_ns[index], data)
            step()
        for index, data in encoder.finish():
            writer.write_video(times_ns[index], data)
    return len(times_ns)
