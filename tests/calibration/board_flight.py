"""A board carried before a camera, as a recording: pictures through H.264, with their times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from board_views import BoardCamera, Waypoints

from ground_station.arrays import F64
from ground_station.recording.h264 import H264Encoder
from pi_firmware.wire.recording import RecordingWriter

START_NS = 1_700_000_000_000_000_000


def write_board_flight(
    path: Path, taker: BoardCamera, motion: Waypoints, times_s: F64,
    exposure_s: float, rng: np.random.Generator, *, crf: float = 18.0,
) -> Path:  # fmt: skip
    """Takes a picture at each time and records it; the recording carries no camera."""
    camera = taker.camera
    rate_hz = 1 / float(np.median(np.diff(times_s)))
    encoder = H264Encoder(camera.width_px, camera.height_px, rate_hz, crf=crf)
    with RecordingWriter(path) as recording:
        for time_s in times_s:
            image = taker.take(motion, float(time_s), exposure_s, rng)
            for index, unit in encoder.encode(np.dstack([image] * 3)):
                recording.write_video(START_NS + round(times_s[index] * 1e9), unit)
        for index, unit in encoder.finish():
            recording.write_video(START_NS + round(times_s[index] * 1e9), unit)
    return path
