"""Small videos whose every frame shows its own number."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

import av
import numpy as np

WIDTH, HEIGHT = 160, 120
FRAMES = 40
START_NS = 1_700_000_000_000_000_001
PERIOD_NS = 33_333_333


def picture(number: int) -> np.ndarray:
    """A picture (H, W) whose brightness is its number, with a ramp below it."""
    image = np.full((HEIGHT, WIDTH), 4 + 6 * number, dtype=np.uint8)
    image[HEIGHT // 2 :] = np.linspace(0, 255, WIDTH).astype(np.uint8)
    return image


def number_in(image: np.ndarray) -> int:
    """The number that a decoded picture shows."""
    return round((float(np.median(image[: HEIGHT // 2 - 8])) - 4) / 6)


def encode(
    pictures: Iterable[np.ndarray], parameters: str = "", *, tune: str = "zerolatency"
) -> list[bytes]:
    """Access units in Annex B form, each with its parameter sets when it is an IDR."""
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    codec.time_base = Fraction(1, 30)
    codec.thread_count = 1
    always = "repeat-headers=1:annexb=1:keyint=10:bframes=0:scenecut=0"
    codec.options = {"crf": "12", "x264-params": f"{always}:{parameters}".rstrip(":")}
    if tune:
        codec.options = {**codec.options, "tune": tune}
    units: list[bytes] = []
    for number, image in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(np.dstack([image] * 3), format="bgr24")
        frame.pts = number
        units += [bytes(packet) for packet in codec.encode(frame)]
    return units + [bytes(packet) for packet in codec.encode(None)]
