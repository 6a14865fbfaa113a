"""H.264 as the payload's encoder leaves it: what a frame looks like after the wireless link."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np

from ground_station.arrays import U8
from ground_station.features.extractor import FeatureError


def round_trip(pictures: list[U8], quantizer: int) -> U8:
    """The last of grey pictures (H, W), equal in size, after encoding and decoding all of them.

    x264 with the payload's settings (main profile, veryfast, zerolatency, no B-frames), but at a
    constant quantizer, 0 to 51: the first picture is an IDR, each other predicted from the one
    before, as frames of a flight are. H and W must be even.
    """
    rows, columns = pictures[0].shape
    if rows % 2 or columns % 2:
        raise FeatureError(f"H.264: {columns}x{rows} px; both must be even")
    encoder = av.CodecContext.create("libx264", "w")
    decoder = av.CodecContext.create("h264", "r")
    if not isinstance(encoder, av.VideoCodecContext) or not isinstance(
        decoder, av.VideoCodecContext
    ):
        raise FeatureError("this build of FFmpeg has no libx264")
    encoder.width, encoder.height, encoder.pix_fmt = columns, rows, "yuv420p"
    encoder.framerate, encoder.time_base = Fraction(30), Fraction(1, 30)
    encoder.thread_count = decoder.thread_count = 1
    encoder.options = {
        "preset": "veryfast",
        "tune": "zerolatency",
        "profile": "main",
        "qp": str(quantizer),
        "bf": "0",
    }
    grey = np.full((rows // 2, columns), 128, np.uint8)
    packets = []
    for k, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(np.concatenate([picture, grey]), format="yuv420p")
        frame.pts = k
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    decoded = [frame for packet in packets for frame in decoder.decode(packet)]
    decoded += decoder.decode(None)
    if len(decoded) != len(pictures):
        raise FeatureError(f"H.264: {len(pictures)} pictures went in, {len(decoded)} came out")
    return np.ascontiguousarray(decoded[-1].to_ndarray(format="yuv420p")[:rows])
