"""Video files as sources of frames: containers with their own times, and raw H.264 streams."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import av

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.recording.frames import ALL_FRAMES, RATE_HZ, Frame, FrameRange
from ground_station.recording.h264 import Decoder, grey, parameter_sets_in
from pi_firmware.wire.errors import os_errors_as

_BLOCK_BYTES = 1 << 18
_REORDERED = 16
"""Pictures that may wait for later ones (ITU-T H.264, A.3.1: MaxDpbFrames is at most 16)."""


class VideoFile:
    """A video in a container (MP4, Matroska, …), with its own timestamps, whatever its frame rate.

    Pictures come as players show them, edit lists obeyed, but not turned. A video without any
    timestamps has those of `rate_hz`; single pictures without one, or with one that is not later
    than the picture's before, come half a usual step after that. A note says so.
    """

    def __init__(
        self, path: Path, rate_hz: float = RATE_HZ, frame_range: FrameRange = ALL_FRAMES
    ) -> None:
        self.path = path
        self.camera: Camera | None = None
        self.notes: list[str] = []
        self._rate_hz = rate_hz
        self._range = frame_range
        with self._open() as container:
            frames = int(container.streams.video[0].frames)
        self._count = frame_range.count(frames) if frames else None

    def count(self) -> int | None:
        return self._count

    def __iter__(self) -> Iterator[Frame]:
        self.notes.clear()
        given = 0
        with self._open() as container:
            repair = _StampRepair(self._rate_hz, container.format.name)
            stream = container.streams.video[0]
            for k, (time_ns, picture) in enumerate(repair.times(self._decode(container, stream))):
                if self._range.is_past(k):
                    break
                if k in self._range:
                    given += 1
                    yield Frame(k, frame_name(k), time_ns, grey(picture))
        self.notes += [f"{self.path}: {note}" for note in repair.notes()]
        check_given(self.path, given, self._range)

    def first_picture(self) -> tuple[int, int, int]:
        """Width, height, and the degrees by which displays turn it clockwise: 0, 90, 180 or 270."""
        with self._open() as container:
            for picture in self._decode(container, container.streams.video[0]):
                # FFmpeg's angle is against the clock.
                return picture.width, picture.height, round(-picture.rotation / 90) % 4 * 90
        raise InputError(f"{self.path}: it gives no video frames")

    def _decode(self, container: Any, stream: Any) -> Iterator[av.VideoFrame]:
        damaged = unseen = k = 0
        reason = ""
        try:
            for packet in container.demux(stream):
                unseen += packet.is_discard  # an edit list leaves it out
                for picture in packet.decode():
                    if picture.is_corrupt:
                        damaged += 1
                        continue
                    k += 1
                    yield picture
        except av.error.FFmpegError as error:
            reason = error.strerror or str(error)
        promised = int(stream.frames)
        if k + damaged + unseen < promised:
            reason = f"its header promises {promised} frames"
        if reason:
            self.notes.append(f"{self.path}: cut ({reason}); {k} frames read")
        if damaged:
            self.notes.append(f"{self.path}: {damaged} damaged frames left out")

    def _open(self) -> Any:
        try:
            container = av.open(str(self.path))
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"{self.path}: not a video that can be read ({reason}); wanted: a video, a"
                " folder of images or a recording (.mcap)"
            ) from None
        if not container.streams.video:
            container.close()
            raise InputError(f"{self.path}: it has no video stream")
        return container


class _StampRepair:
    """Times of pictures in the order of display: those of the container, later by each picture.

    AVI stores one time an entry in the order of decoding, so that times come permuted where
    pictures wait for later ones: there the k-th picture has the k-th time.
    """

    def __init__(self, rate_hz: float, container: str) -> None:
        self._waiting = _REORDERED if container == "avi" else 0
        self._step_ns = self._nominal_ns = round(1e9 / rate_hz)
        self._last_ns: int | None = None
        self._timed = self._untimed = self._late = 0

    def times(self, pictures: Iterator[av.VideoFrame]) -> Iterator[tuple[int, av.VideoFrame]]:
        """Each picture with its time, nanoseconds."""
        waiting: deque[tuple[bool, av.VideoFrame]] = deque()
        pending: list[int] = []
        for picture in pictures:
            has_time = False
            if picture.pts is not None and picture.time_base is not None:
                has_time = True
                heappush(pending, round(picture.pts * picture.time_base * 1_000_000_000))
            waiting.append((has_time, picture))
            if len(waiting) > self._waiting:
                has_time, picture = waiting.popleft()
                yield self._at(heappop(pending) if has_time else None), picture
        for has_time, picture in waiting:
            yield self._at(heappop(pending) if has_time else None), picture

    def _at(self, time_ns: int | None) -> int:
        last = self._last_ns
        if time_ns is None:
            self._untimed += 1
        else:
            self._timed += 1
            if last is None or time_ns > last:
                if last is not None and self._timed > 1:
                    self._step_ns = time_ns - last
                self._last_ns = time_ns
                return time_ns
            self._late += 1
        if last is None:
            time_ns = 0
        else:
            time_ns = last + (self._step_ns // 2 if self._timed else self._nominal_ns)
        self._last_ns = time_ns
        return time_ns

    def notes(self) -> Iterator[str]:
        """What was repaired."""
        if self._untimed and not self._timed:
            rate_hz = 1e9 / self._nominal_ns
            yield f"{self._untimed} frames without a time, taken at {rate_hz:g} Hz"
        elif self._untimed:
            yield f"{self._untimed} frames without a time, put after those before them"
        if self._late:
            yield f"{self._late} frames not later than those before them, put after them"


class AnnexBFile:
    """A raw H.264 byte stream (Annex B). It has no times: picture k is at k / `rate_hz` s."""

    def __init__(
        self, path: Path, rate_hz: float = RATE_HZ, frame_range: FrameRange = ALL_FRAMES
    ) -> None:
        self.path = path
        self.camera: Camera | None = None
        self.notes: list[str] = []
        self._rate_hz = rate_hz
        self._range = frame_range
        if not parameter_sets_in(self._blocks()):
            raise InputError(f"{path}: the stream carries no H.264 parameter sets (SPS/PPS)")

    def count(self) -> int | None:
        return None

    def __iter__(self) -> Iterator[Frame]:
        self.notes.clear()
        decoder = Decoder()
        given = 0
        k = -1
        for k, picture in enumerate(self._pictures(decoder)):
            if self._range.is_past(k):
                break
            if k in self._range:
                given += 1
                yield Frame(k, frame_name(k), round(k * 1e9 / self._rate_hz), grey(picture))
        else:
            if decoder.damaged:
                self.notes.append(
                    f"{self.path}: cut or damaged; {k + 1} whole frames read, "
                    f"{decoder.damaged} left out"
                )
        check_given(self.path, given, self._range)

    def _pictures(self, decoder: Decoder) -> Iterator[av.VideoFrame]:
        """All whole pictures in display order."""
        for number, unit in enumerate(self._access_units()):
            for _, picture in decoder.decode(unit, number):
                yield picture
        for _, picture in decoder.flush():
            yield picture

    def _access_units(self) -> Iterator[bytes]:
        parser: Any = av.CodecContext.create("h264", "r")
        for block in self._blocks():
            for packet in parser.parse(block):
                yield bytes(packet)
        for packet in parser.parse():
            yield bytes(packet)

    def _blocks(self) -> Iterator[bytes]:
        with os_errors_as(self.path, InputError), self.path.open("rb") as file:
            while block := file.read(_BLOCK_BYTES):
                yield block


def frame_name(k: int) -> str:
    """The name of the k-th frame of a video."""
    return f"frame-{k:06d}"


def check_given(path: Path, given: int, frame_range: FrameRange) -> None:
    """Raises `InputError` when an input gave no frame at all."""
    if not given:
        where = "" if frame_range == ALL_FRAMES else f" in the range {frame_range}"
        raise InputError(f"{path}: it gives no video frames{where}")
