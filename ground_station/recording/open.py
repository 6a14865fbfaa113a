"""One door for every input: a folder of images, a video file, or a recording."""

from __future__ import annotations

import math
import re
from pathlib import Path

from ground_station.errors import InputError
from ground_station.recording.flight import FlightRecording
from ground_station.recording.folder import ImageFolder
from ground_station.recording.frames import ALL_FRAMES, RATE_HZ, FrameRange, FrameSource
from ground_station.recording.video import AnnexBFile, VideoFile
from pi_firmware.wire.errors import os_errors_as
from pi_firmware.wire.mcap_records import MAGIC

_ANNEX_B_SUFFIXES = {".h264", ".264", ".avc"}


def open_input(
    path: str | Path, rate_hz: float | None = None, frame_range: FrameRange | None = None
) -> FrameSource:
    """The frames of an input; nothing is decoded before the iteration.

    `rate_hz` gives times to what has none (folders, raw H.264): frame k is at k / rate_hz s,
    whatever the range. None: images named by their times have those, all else 30 Hz. Raises
    `InputError`, `RecordingError` or `CameraError`, one line each, here or while iterating.
    """
    path = Path(path)
    wanted = frame_range or ALL_FRAMES
    if rate_hz is not None and not (math.isfinite(rate_hz) and 0.001 <= rate_hz <= 10_000):
        raise InputError(f"the frame rate is {rate_hz} Hz; allowed: 0.001 to 10000 Hz")
    if path.is_dir():
        return ImageFolder(path, rate_hz, wanted)
    with os_errors_as(path, InputError), path.open("rb") as file:
        head = file.read(8)
    if not head:
        raise InputError(f"{path}: the file is empty; copy it again from where it was made")
    if head == MAGIC or path.suffix.lower() == ".mcap":
        return FlightRecording(path, wanted)
    if path.suffix.lower() in _ANNEX_B_SUFFIXES or _starts_as_annex_b(head):
        return AnnexBFile(path, rate_hz or RATE_HZ, wanted)
    return VideoFile(path, rate_hz or RATE_HZ, wanted)


def _starts_as_annex_b(head: bytes) -> bool:
    """Whether a file begins with the start code of a NAL unit that H.264 puts first."""
    match = re.match(rb"\x00{2,3}\x01(.)", head, re.DOTALL)
    return match is not None and match[1][0] < 0x80 and match[1][0] & 0x1F in (1, 5, 6, 7, 9)


def parse_range(text: str) -> FrameRange:
    """`A:B` or `A:B:S` (frames A to B without B, every S-th; A and B may be left out)."""
    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::(\d{1,9}))?", text.strip(), re.ASCII)
    if match:
        start = int(match[1] or 0)
        stop = int(match[2]) if match[2] else None
        step = int(match[3] or 1)
        if step >= 1 and (stop is None or start < stop):
            return FrameRange(start, stop, step)
    raise InputError(f"the range {text!r:.60} is not A:B or A:B:S with 0 <= A < B and S >= 1")
