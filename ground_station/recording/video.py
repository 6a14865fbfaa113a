"""Video files as sources of frames: containers with their own times, and raw H.264 streams."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.recording.frames import ALL_FRAMES, Frame, FrameRange
from ground_station.recording.h264 import Decoder, grey, parameter_sets_in

_BLOCK_BYTES = 1 << 18


class VideoFile:
    """A video in a container (MP4, Matroska, …), with its own timestamps.

    A picture without a timestamp is at k / `rate_hz` s, and a note says so.
    """

    def __init__(
        self, path: Path, rate_hz: float = 30.0, frame_range: FrameRange = ALL_FRAMES
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
        untimed = given = k = 0
        with self._open() as container:
            stream = container.streams.video[0]
            for k, picture in enumerate(self._decode(container, stream)):
                if self._range.is_past(k):
                    break
                if k not in self._range:
                    continue
                if picture.pts is None or picture.time_base is None:
                    untimed += 1
                    time_ns = round(k * 1e9 / self._rate_hz)
                else:
                    time_ns = round(picture.pts * picture.time_base * 1_000_000_000)
                given += 1
                yield Frame(k, frame_name(k), time_ns, grey(picture))
        if untimed:
            self.notes.append(
                f"{self.path}: {untimed} frames without a time, taken at {self._rate_hz:g} Hz"
            )
        check_given(self.path, given, self._range)

    def _decode(self, container: Any, stream: Any) -> Iterator[av.VideoFrame]:
        damaged = k = 0
        reason = ""
        try:
            for picture in container.decode(stream):
                if picture.is_corrupt:
                    damaged += 1
                    continue
                k += 1
                yield picture
        except av.error.FFmpegError as error:
            reason = error.strerror or str(error)
        promised = int(stream.frames)
        if k + damaged < promised:
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
            raise InputError(f"{self.path}: not a video that can be read ({reason})") from None
        if not container.streams.video:
            container.close()
            raise InputError(f"{self.path}: it has no video stream")
        return container


class AnnexBFile:
    """A raw H.264 byte stream (Annex B). It has no times: picture k is at k / `rate_hz` s."""

    def __init__(
        self, path: Path, rate_hz: float = 30.0, frame_range: FrameRange = ALL_FRAMES
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
        try:
            with self.path.open("rb") as file:
                while block := file.read(_BLOCK_BYTES):
                    yield block
        except OSError as error:
            raise InputError(f"{self.path}: {error.strerror or error}") from None


def frame_name(k: int) -> str:
    """The name of the k-th frame of a video."""
    return f"frame-{k:06d}"


def check_given(path: Path, given: int, frame_range: FrameRange) -> None:
    """Raises `InputError` when an input gave no frame at all."""
    if not given:
        where = "" if frame_range == ALL_FRAMES else f" in the range {frame_range}"
        raise InputError(f"{path}: it gives no video frames{where}")
