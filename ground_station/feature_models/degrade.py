"""What light, lens, sensor and link do to a view: the same place, never the same picture.

In the order in which it happens: light and shadow, defocus and motion, exposure and tone curve,
noise, compression. Pictures are grey, (H, W), uint8 outside and float32 0..1 in between.
"""

from __future__ import annotations

from fractions import Fraction

import av
import cv2
import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, U8
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


Rng = np.random.Generator


_LIGHT, _SHADOW, _DEFOCUS, _MOTION = 0.7, 0.35, 0.35, 0.35
_TONE, _NOISE, _COMPRESSION = 0.85, 0.8, 0.55
"""How often each happens to a view; it is then of a random strength."""


def degrade(picture: U8, rng: Rng) -> U8:
    """A picture (H, W), H and W even, as a payload in other light might have sent it."""
    linear = (picture.astype(np.float32) * np.float32(1 / 255)) ** np.float32(2.2)
    if rng.random() < _LIGHT:
        linear *= light(linear.shape, rng)
    if rng.random() < _SHADOW:
        linear *= shadow(linear.shape, rng)
    if rng.random() < _DEFOCUS:
        linear = defocus(linear, float(rng.gamma(2.0, 0.45)))
    motion = np.zeros(2)
    if rng.random() < _MOTION:
        motion = rng.normal(0, 1, 2) * rng.uniform(0.5, 4)
        linear = motion_blur(linear, motion)
    # A blur by a Fourier transform leaves black a little below nought, which has no power.
    linear = np.maximum(linear, 0)
    tone = rng.random() < _TONE
    code = developed(linear, rng) if tone else linear ** np.float32(1 / 2.2)
    if rng.random() < _NOISE:
        code = noisy(code, rng)
    result = quantized(code)
    if rng.random() < _COMPRESSION:
        # The frame before was taken a little elsewhere, and has another noise.
        step = np.array([[1, 0, 2 * motion[0]], [0, 1, 2 * motion[1]]], np.float32)
        before = cv2.warpAffine(
            code, step, (code.shape[1], code.shape[0]), borderMode=cv2.BORDER_REPLICATE
        )
        before = quantized(np.asarray(before, np.float32) + _grain(code.shape, 0.01, rng))
        result = round_trip([before, result], int(rng.integers(22, 41)))
    return result


def quantized(code: F32) -> U8:
    """Values 0..1, clipped, as eight bits."""
    return (np.clip(code, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def light(shape: tuple[int, ...], rng: Rng) -> F32:
    """A factor (H, W): a gradient over the picture, cones of lamps, the lens's vignette."""
    y, x = _grid(shape)
    angle, slope = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.6)
    factor = np.exp(np.float32(slope) * (np.float32(np.cos(angle)) * x + np.sin(angle) * y))
    for _ in range(int(rng.integers(0, 4))):
        cx, cy = rng.uniform(-1.2, 1.2, 2)
        wide, turn = rng.uniform(0.15, 1.0), rng.uniform(0, np.pi)
        a = np.cos(turn) * (x - cx) + np.sin(turn) * (y - cy)
        b = (np.cos(turn) * (y - cy) - np.sin(turn) * (x - cx)) * rng.uniform(1, 3)
        factor = factor + np.float32(rng.uniform(0.3, 4)) * np.exp(-(a * a + b * b) / wide**2)
    factor *= 1 - np.float32(rng.uniform(0, 0.45)) * (x * x + y * y) / 2
    return np.asarray(factor / factor.mean(), np.float32)


def shadow(shape: tuple[int, ...], rng: Rng) -> F32:
    """A factor (H, W): window bars, people, edges of roofs, as polygons with soft edges."""
    rows, columns = shape
    mask = np.zeros((rows, columns), np.float32)
    size = np.array([columns, rows])
    for _ in range(int(rng.integers(1, 4))):
        if rng.random() < 0.5:  # parallel stripes, as of a window's frame
            a = rng.uniform(0, np.pi)
            along, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
            wide, gap = rng.uniform(6, 50), rng.uniform(10, 90)
            start = rng.uniform(0, 1, 2) * size
            for k in range(int(rng.integers(1, 6))):
                middle = start + across * k * (wide + gap)
                corners = [
                    middle + s * along * columns + t * across * wide / 2
                    for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))
                ]
                cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1.0)
        else:
            angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
            radius = rng.uniform(0.08, 0.6) * columns * rng.uniform(0.6, 1, len(angle))
            ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius[:, None]
            corners = ring + rng.uniform(0, 1, 2) * size
            cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1.0)
    soft = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.7, 6)))
    return np.asarray(1 - np.float32(rng.uniform(0.3, 0.9)) * soft, np.float32)


def defocus(linear: F32, radius_px: float) -> F32:
    """The mean over a disc, its edge antialiased; a radius below half a pixel changes nothing."""
    if radius_px < 0.5:
        return linear
    reach = int(np.ceil(radius_px))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.clip(radius_px + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    blurred = cv2.filter2D(linear, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, np.float32)


def motion_blur(linear: F32, motion_px: npt.ArrayLike) -> F32:
    """The mean over a straight way of `motion_px` (x, y), centred, so that nothing shifts."""
    dx, dy = np.asarray(motion_px, np.float64).tolist()
    reach = int(np.ceil(max(abs(dx), abs(dy)) / 2)) + 1
    side = 2 * reach + 1
    kernel = np.zeros(side * side, np.float64)
    count = 4 * side
    t = (np.arange(count) + 0.5) / count - 0.5
    x, y = reach + t * dx, reach + t * dy
    for sx in (0, 1):
        for sy in (0, 1):
            i, j = np.floor(x).astype(int) + sx, np.floor(y).astype(int) + sy
            np.add.at(kernel, j * side + i, (1 - abs(x - i)) * (1 - abs(y - j)))
    square = (kernel / kernel.sum()).reshape(side, side).astype(np.float32)
    return np.asarray(
        cv2.filter2D(linear, -1, square, borderType=cv2.BORDER_REFLECT_101), np.float32
    )


def developed(linear: F32, rng: Rng) -> F32:
    """Exposure, white balance as grey sees it, gamma and the S of a contrast curve: 0..1."""
    # Auto exposure aims at the mean, and misses it.
    target = np.exp(rng.normal(np.log(0.19), 0.55))
    level = linear * np.float32(target / max(float(linear.mean()), 1e-4))
    shoulder = np.float32(rng.uniform(2, 8))
    level = level * (1 + level / shoulder**2) / (1 + level)  # Reinhard et al. 2002, eq. 4
    code = np.clip(level, 0, 1) ** np.float32(1 / rng.uniform(1.6, 2.8))
    code += np.float32(rng.uniform(-0.3, 0.9)) * (code * code * (3 - 2 * code) - code)
    if rng.random() < 0.3:
        code = code * np.float32(rng.uniform(0.35, 1)) + np.float32(rng.uniform(0, 0.25))
    return np.asarray(code, np.float32)


def noisy(code: F32, rng: Rng) -> F32:
    """Shot noise, which grows with the light, and the noise of reading; sometimes scaled up."""
    gain = np.exp(rng.uniform(np.log(0.003), np.log(0.06)))
    deviation = np.float32(gain) * np.sqrt(0.25 + np.clip(code, 0, 1)).astype(np.float32)
    return np.asarray(code + deviation * _grain(code.shape, 1.0, rng))


def _grain(shape: tuple[int, ...], deviation: float, rng: Rng) -> F32:
    grain = rng.standard_normal(shape, dtype=np.float32)
    if rng.random() < 0.3:  # a sensor's picture scaled: neighbours share some of it
        grain = 1.8 * cv2.GaussianBlur(grain, (0, 0), 0.6)
    return np.float32(deviation) * grain


def _grid(shape: tuple[int, ...]) -> tuple[F32, F32]:
    y = np.linspace(-1, 1, shape[0], dtype=np.float32)[:, None]
    return y, np.linspace(-1, 1, shape[1], dtype=np.float32)[None, :]
