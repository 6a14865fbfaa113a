"""A short flight whose pictures carry their own number: what tests of the stream fly."""

from __future__ import annotations

import functools
import itertools
import struct
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from pi_firmware.wire import annexb, sei
from pi_firmware.wire.recording import FRAME_INFO_TOPIC, RecordingWriter

WIDTH_PX, HEIGHT_PX, RATE_HZ, GOP = 640, 480, 30, 15
START_NS = 1_700_000_000_123_456_789
BITS, BLOCK_PX = 12, 32


def capture_ns(index: int) -> int:
    """The recorded capture time of frame `index`: 30 Hz with a millisecond of jitter."""
    return START_NS + index * 1_000_000_000 // RATE_HZ + (index * 7919) % 1_000_000


def picture(index: int, *, dark: bool = False) -> NDArray[np.uint8]:
    """A moving picture (H, W), rich in grey levels unless dark, with its number in blocks."""
    u, v = np.arange(WIDTH_PX), np.arange(HEIGHT_PX)[:, None]
    wave = np.sin((u + 3 * index) / 17.0) + np.cos((v - 2 * index) / 23.0) + u / WIDTH_PX
    image = np.full(wave.shape, 16.0) if dark else 128 + 36 * wave
    image = np.clip(image, 0, 255).astype(np.uint8)
    for bit in range(BITS):
        image[:BLOCK_PX, bit * BLOCK_PX : (bit + 1) * BLOCK_PX] = 220 if index >> bit & 1 else 20
    return image


def number_in(image: NDArray[np.uint8]) -> int:
    """The number that `picture` wrote, from gray (H, W) or colour (H, W, 3)."""
    inner = slice(BLOCK_PX // 4, 3 * BLOCK_PX // 4)
    blocks = (
        image[inner, bit * BLOCK_PX : (bit + 1) * BLOCK_PX][:, inner].mean() for bit in range(BITS)
    )
    return sum(1 << bit for bit, level in enumerate(blocks) if level > 120)


def encoded(
    frames: int, dark: frozenset[int] = frozenset(), slices: int = 1, more: str = "cabac=0"
) -> tuple[bytes, ...]:
    """Access units of the flight's first `frames` pictures: no B-frames, an IDR each 15.

    `more` are settings of x264's.
    """
    made, later = _encoding(dark, slices, more)
    made += itertools.islice(later, max(0, frames - len(made)))
    return tuple(made[:frames])


@functools.cache
def _encoding(dark: frozenset[int], slices: int, more: str) -> tuple[list[bytes], Iterator[bytes]]:
    """The access units that were made so far, and those to come."""
    return [], _encode(dark, slices, more)


def _encode(dark: frozenset[int], slices: int, more: str) -> Iterator[bytes]:
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    codec.thread_count = 1
    codec.options = {
        "tune": "zerolatency", "preset": "ultrafast", "crf": "18", "g": str(GOP),
        "slices": str(slices), "x264-params": more,
    }  # fmt: skip
    for index in itertools.count():
        gray = picture(index, dark=index in dark)
        frame = av.VideoFrame.from_ndarray(np.dstack([gray] * 3), format="rgb24")
        frame.pts = index
        (packet,) = codec.encode(frame)
        yield bytes(packet)


def write_flight(path: Path, frames: int, dark: Iterable[int] = ()) -> Path:
    """The flight as an MCAP recording, with exposure and gain."""
    with RecordingWriter(path, chunk_bytes=64 * 1024) as recording:
        for index, unit in enumerate(encoded(frames, frozenset(dark))):
            recording.write_video(capture_ns(index), unit)
            recording.write_json(
                FRAME_INFO_TOPIC,
                capture_ns(index),
                {"sequence": index, "exposure_s": 0.01 + index / 2**16, "gain": 2.0},
                schema_name="blimp.frame",
            )
    return path


def stamped(unit: bytes, index: int, exposure_s: float | None = None) -> bytes:
    """The access unit with the numbers that the payload would put into it."""
    info = sei.FrameInfo(
        sequence=index,
        time_ns=capture_ns(index),
        clock_ns=capture_ns(index) + 5,
        entropy_bits=7.0,
        sharpness=10.0,
        exposure_s=exposure_s,
    )
    return annexb.insert_before_slice(unit, sei.encode(info))


def packets(
    units: Sequence[bytes], *, ssrc: int = 77, first: int = 65_500, mtu_bytes: int = 1200
) -> list[bytes]:
    """RTP packets of access units, by RFC 6184: single NAL units and FU-A, no aggregation."""
    result: list[bytes] = []
    for index, unit in enumerate(units):
        payloads = []
        for nal in annexb.nal_units(unit):
            if len(nal) <= mtu_bytes:
                payloads.append(nal)
                continue
            pieces = [nal[at : at + mtu_bytes] for at in range(1, len(nal), mtu_bytes)]
            for number, piece in enumerate(pieces):
                ends = (0x80 if number == 0 else 0) | (0x40 if number == len(pieces) - 1 else 0)
                payloads.append(bytes([nal[0] & 0xE0 | 28, ends | nal[0] & 0x1F]) + piece)
        for number, payload in enumerate(payloads):
            marker = 0x80 if number == len(payloads) - 1 else 0
            sequence = (first + len(result)) & 0xFFFF
            header = struct.pack(">BBHII", 0x80, marker | 96, sequence, 3000 * index, ssrc)
            result.append(header + payload)
    return result


def start_payload(*settings: str) -> subprocess.Popen[str]:
    """The payload's program as its own process, with `--set` for each of the settings."""
    command = [sys.executable, "-m", "pi_firmware"]
    for setting in settings:
        command += ["--set", setting]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
