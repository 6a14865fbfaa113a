"""Access units into pictures; only pictures whose references all arrived."""

from __future__ import annotations

import av
import numpy as np
from numpy.typing import NDArray

from ground_station.recording.h264 import grey
from ground_station.stream.counters import Counters
from ground_station.stream.rtp import AccessUnit
from pi_firmware.wire import annexb

_MAX_PIXELS = 1920 * 1088
"""A stranger's parameter sets must not make the decoder ask for gigabytes."""


class Decoder:
    """Decodes the access units of one stream; withholds after a loss until the next IDR.

    Decoders paint over what is missing and don't say so, hence this one never sees a damaged access
    unit, nor one that refers to it.
    """

    def __init__(self, counters: Counters) -> None:
        self.saw_parameter_sets = False
        self._counters = counters
        self._trusted = False
        self._codec = _open()

    def decode(self, unit: AccessUnit) -> NDArray[np.uint8] | None:
        """The picture, gray (H, W) uint8 of full range; None when withheld."""
        if unit.follows_gap or not unit.complete:
            self._trusted = False
        if unit.complete:
            types = annexb.nal_types(unit.data)
            if annexb.NAL_SPS in types and annexb.NAL_PPS in types:
                self.saw_parameter_sets = True
            if annexb.NAL_IDR in types and self.saw_parameter_sets:
                self._trusted = True
        if not self._trusted:
            self._counters.withheld += 1
            return None
        try:
            (frame,) = self._codec.decode(av.Packet(unit.data))
            return grey(frame)
        except (av.FFmpegError, ValueError):  # ValueError: not exactly one picture
            self._counters.failed += 1
            self._trusted = False
            self._codec = _open()
            return None


def _open() -> av.VideoCodecContext:
    codec = av.CodecContext.create("h264", "r")
    assert isinstance(codec, av.VideoCodecContext)
    codec.thread_count = 1  # frame threads would hold pictures back
    codec.flags |= int(av.codec.context.Flags.low_delay)
    codec.options = {"max_pixels": str(_MAX_PIXELS)}
    return codec
