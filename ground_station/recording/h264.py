"""H.264 access units to grey pictures, each with its access unit's number, and the way back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import Any

import av
import numpy as np
from av.video.frame import PictureType

from ground_station.arrays import U8
from pi_firmware.wire import annexb


class H264Encoder:
    """Encodes 8-bit pictures, RGB or grey; access units come out in the order the pictures went in.

    `crf` is x264's constant quality (0 to 51, smaller is better), unless `bitrate_kbps` is given.
    One thread, so that equal pictures give equal bytes.
    """

    def __init__(
        self,
        width_px: int,
        height_px: int,
        rate_hz: float,
        *,
        crf: float = 20.0,
        bitrate_kbps: int | None = None,
    ) -> None:
        context = av.CodecContext.create("libx264", "w")
        assert isinstance(context, av.VideoCodecContext)
        context.width, context.height, context.pix_fmt = width_px, height_px, "yuv420p"
        rate = Fraction(rate_hz).limit_denominator(1000)
        context.framerate, context.time_base = rate, 1 / rate
        context.max_b_frames = 0
        context.gop_size = max(1, int(rate_hz))  # an IDR at most a second apart
        context.thread_count = 1
        options = {"preset": "medium", "forced-idr": "1", "profile": "high"}
        # Level 3.0 carries 640x480 at 30 Hz; more only when it must.
        macroblocks = -(-width_px // 16) * -(-height_px // 16)
        levels = (
            (3.0, 1620, 40500),
            (3.1, 3600, 108000),
            (4.0, 8192, 245760),
            (5.1, 36864, 983040),
        )
        for level, frame_limit, rate_limit in levels:
            if macroblocks <= frame_limit and macroblocks * rate_hz <= rate_limit:
                options["level"] = str(level)
                break
        if bitrate_kbps is None:
            options["crf"] = str(crf)
        else:
            context.bit_rate = bitrate_kbps * 1000
        context.options = options
        self._context = context
        self._count = 0

    def encode(self, picture: U8, *, idr: bool = False) -> Iterator[tuple[int, bytes]]:
        """Takes a picture, (H, W, 3) RGB or (H, W) grey of full range; as an IDR if asked.

        Yields (index, access unit) of those that are ready.
        """
        if picture.ndim == 2:
            picture = np.repeat(picture[:, :, None], 3, axis=2)
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p")
        if idr:
            frame.pict_type = PictureType.I
        frame.pts = self._count
        self._count += 1
        yield from self._packets(frame)

    def finish(self) -> Iterator[tuple[int, bytes]]:
        """Yields what is still inside."""
        yield from self._packets(None)

    def _packets(self, frame: av.VideoFrame | None) -> Iterator[tuple[int, bytes]]:
        for packet in self._context.encode(frame):
            assert packet.pts is not None
            yield int(packet.pts), bytes(packet)


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
