"""H.264 access units to grey pictures, each with the number of the access unit it came from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import av
import numpy as np

from ground_station.arrays import U8
from pi_firmware.wire import annexb

_LUMA_8_BIT = {"yuv420p", "yuv422p", "yuv444p", "nv12", "nv21", "gray"}
_FULL_RANGE_8_BIT = {"yuvj420p", "yuvj422p", "yuvj444p"}
_FULL_RANGE = 2  # av.video.reformatter.ColorRange.JPEG

MAX_PIXELS = 8192 * 4320
"""Parameter sets that claim more are refused: they could ask for gigabytes."""

_LIMITED_TO_FULL = bytes(
    np.clip(np.round((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8).tolist()
)
"""Luma of 16 to 235 (ITU-R BT.601, 2.5.3) to grey of 0 to 255."""


def parameter_sets_in(blocks: Iterable[bytes]) -> bool:
    """Whether a byte stream, given block by block, has both an SPS and a PPS somewhere."""
    missing = {annexb.NAL_SPS, annexb.NAL_PPS}
    tail = b""
    for block in blocks:
        missing -= set(annexb.nal_types(tail + block))
        if not missing:
            return True
        tail = block[-3:]
    return False


def grey(frame: av.VideoFrame) -> U8:
    """The picture (H, W) as full-range grey, 0 black to 255 white.

    8-bit luma is taken from the decoder's plane as it is; limited range, which H.264 has unless it
    says otherwise, is stretched by a table, so that a video and the images it was made of agree.
    """
    name = frame.format.name
    if name not in _LUMA_8_BIT | _FULL_RANGE_8_BIT:
        return np.asarray(
            frame.to_ndarray(format="gray"), np.uint8
        )  # rare formats: the converter stretches, too
    plane = frame.planes[0]
    luma = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
    luma = luma[: frame.height, : frame.width]
    full = name in _FULL_RANGE_8_BIT or name == "gray" or int(frame.color_range) == _FULL_RANGE
    if full:
        return luma.copy()
    # The intake, which decodes, starts sooner without OpenCV's table.
    stretched = bytearray(luma.tobytes()).translate(_LIMITED_TO_FULL)
    return np.frombuffer(stretched, np.uint8).reshape(luma.shape)


class Decoder:
    """Decodes access units one by one; a picture keeps the number of its access unit.

    The number travels as the packet's timestamp, so a decoder that gives pictures late (it may hold
    back one or more) does not shift them. `damaged` counts access units that cannot be decoded and
    pictures that the decoder itself calls corrupt; neither is given out.
    """

    def __init__(self) -> None:
        self._codec: Any = av.CodecContext.create("h264", "r")
        self._codec.thread_count = 1  # threads would hold back one picture each
        self._codec.options = {"max_pixels": str(MAX_PIXELS)}
        self.damaged = 0

    def decode(self, data: bytes, number: int) -> Iterator[tuple[int, av.VideoFrame]]:
        """Feeds one access unit; gives the pictures that are complete by now."""
        packet = av.Packet(data)
        packet.pts = number
        yield from self._drain(packet)

    def flush(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """The pictures still held back at the end."""
        yield from self._drain(None)

    def _drain(self, packet: av.Packet[Any] | None) -> Iterator[tuple[int, av.VideoFrame]]:
        try:
            frames = self._codec.decode(packet)
        except av.error.FFmpegError:  # this access unit is lost; a later one may be whole
            self.damaged += 1
            return
        for frame in frames:
            if frame.is_corrupt or frame.pts is None:
                self.damaged += 1
            else:
                yield int(frame.pts), frame
