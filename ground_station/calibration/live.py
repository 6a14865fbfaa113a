"""A payload's live video as a source of frames, for a person who holds the board before it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

from ground_station.errors import InputError
from ground_station.geometry.camera import Camera
from ground_station.recording.frames import Frame
from ground_station.recording.video import frame_name
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.multi_stream import MultiStreamReceiver
from ground_station.stream.newest import Newest
from pi_firmware.wire.video import PORT

_QUEUE_FRAMES = 4
_URI = re.compile(r"udp:(?://(?P<host>\[[0-9A-Fa-f:.]+\]|[\w.-]*)(?::(?P<port>\d{1,5}))?)?/?")


def parse_uri(uri: str) -> tuple[str, int]:
    """Host and port of `udp://HOST:PORT`: loopback and the video's port where left out.

    Raises `InputError` with one line.
    """
    match = _URI.fullmatch(uri)
    port = int(match["port"] or PORT) if match else 0
    if match is None or not 1 <= port <= 65535:
        raise InputError(f"{uri!r:.60} is not udp://HOST:PORT with a port of 1 to 65535")
    return (match["host"] or "127.0.0.1").strip("[]"), port


class LiveFrames:
    """The frames of an RTP stream for `seconds` from the first one on; once only.

    It takes plain RTP. Where the payload's video is encrypted, `blimp record` has the keys: give
    its recording instead.
    """

    def __init__(self, uri: str, seconds: float) -> None:
        self.camera: Camera | None = None
        self.notes: list[str] = []
        self._uri, self._seconds = uri, seconds
        self._host, self._port = parse_uri(uri)

    def count(self) -> int | None:
        return None

    def __iter__(self) -> Iterator[Frame]:
        newest: Newest[ReceivedFrame] = Newest(_QUEUE_FRAMES)
        with MultiStreamReceiver(
            self._port,
            self._host,
            owner=_whoever_comes,
            on_frame=lambda _, frame: newest.put(frame),
            max_streams=1,
        ) as receiver:
            until_s = time.monotonic() + self._seconds
            given = 0
            while (left_s := until_s - time.monotonic()) > 0:
                received = newest.take(min(left_s, 0.5))
                if received is None:
                    told = [stream.problem for stream in receiver.streams()]
                    if problem := receiver.failure or "".join(told):
                        raise InputError(f"{self._uri}: {problem}")
                    continue
                if not given:
                    until_s = time.monotonic() + self._seconds
                yield Frame(
                    given, frame_name(given), received.time_ns, received.image, received.exposure_s
                )
                given += 1
        if not given:
            raise InputError(f"{self._uri}: no video came within {self._seconds:g} s")
        if newest.skipped:
            self.notes.append(
                f"{self._uri}: {newest.skipped} frames skipped while others were looked at"
            )


def _whoever_comes(ssrc: int, key_owner: str | None, age_s: float) -> str | None:
    """The one payload before the board: no telemetry says whose a stream is."""
    return "payload" if age_s > 0 else None
