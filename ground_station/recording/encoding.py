"""H.264 as the payload sends it: Annex B, no B-frames, parameter sets with every IDR."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import av
import numpy as np
from av.video.frame import PictureType

from ground_station.arrays import U8


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
