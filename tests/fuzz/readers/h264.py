"""Access units for seeds: two pictures of 64x48 as the payload sends them, with their SEI."""

from __future__ import annotations

import functools

import numpy as np

from ground_station.recording.h264 import H264Encoder
from pi_firmware.wire import annexb, sei


def info(sequence: int = 1) -> sei.FrameInfo:
    """A frame's numbers."""
    return sei.FrameInfo(sequence, 10**9 * sequence, 10**9 * sequence, 7.0, 100.0, 0.01, 1.0)


@functools.cache
def access_units(count: int = 2) -> tuple[bytes, ...]:
    """The first is an IDR with its parameter sets."""
    encoder, found = H264Encoder(64, 48, 30.0, crf=40), []
    for number in range(count):
        picture = np.full((48, 64, 3), 90 + 20 * number, np.uint8)
        found += [data for _, data in encoder.encode(picture)]
    found += [data for _, data in encoder.finish()]
    return tuple(
        annexb.insert_before_slice(data, sei.encode(info(n))) for n, data in enumerate(found)
    )
