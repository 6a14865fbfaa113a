"""The video of one payload, for tests that want to see what it sends: the service's own receiver.

No telemetry says here whose a stream is: the first one is taken, or the one that is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from ground_station.stream.arrivals import Flow
from ground_station.stream.assembly import ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.multi_stream import MultiStreamReceiver, Stream
from ground_station.stream.newest import Newest

NAMELESS = "payload"


class Receiver:
    """A context manager; `Feedback` can report on it."""

    def __init__(
        self,
        port: int = 0,
        host: str = "127.0.0.1",
        *,
        queue_frames: int = 4,
        ssrc: int | None = None,
        srtp_keys: Mapping[str, bytes] | None = None,
    ) -> None:
        self._wanted = ssrc
        self._frames: Newest[ReceivedFrame] = Newest(queue_frames)
        self._last: Stream | None = None
        self.multi = MultiStreamReceiver(
            port,
            host,
            owner=self._owner,
            on_frame=lambda _, frame: self._frames.put(frame),
            max_streams=1,
            srtp_keys=srtp_keys,
        )
        self.host, self.port = self.multi.host, self.multi.port

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops receiving; frames still queued can be taken."""
        self._stream()
        self.multi.close()

    def _owner(self, ssrc: int, key_owner: str | None, age_s: float) -> str | None:
        return (key_owner or NAMELESS) if self._wanted in (None, ssrc) else None

    def _stream(self) -> Stream | None:
        self._last = next(iter(self.multi.streams()), self._last)
        return self._last

    def get(self, timeout_s: float = 1.0) -> ReceivedFrame | None:
        """The oldest frame in the queue, or None when none comes in time."""
        return self._frames.take(timeout_s)

    @property
    def dropped(self) -> int:
        """Frames that nobody took."""
        return self._frames.skipped

    @property
    def counters(self) -> Counters:
        """The port's and the stream's."""
        stream = self._stream()
        both = (self.multi.counters, stream.counters if stream else Counters())
        return Counters(**{f.name: sum(getattr(c, f.name) for c in both) for f in fields(Counters)})

    @property
    def ssrc(self) -> int | None:
        """The stream that is received."""
        stream = self._stream()
        return stream.ssrc if stream else None

    @property
    def payload_id(self) -> str | None:
        """Whose stream it is, by its key; None before there is one, or without keys."""
        stream = self._stream()
        return stream.payload_id if stream and stream.payload_id != NAMELESS else None

    @property
    def problem(self) -> str:
        """Why the stream cannot be shown."""
        stream = self._stream()
        return stream.problem if stream else ""

    def flow(self) -> Flow | None:
        """How it arrives of late."""
        stream = self._stream()
        return stream.flow() if stream else None

    def retransmits(self, rtx_ssrc: int | None, round_trip_s: float | None) -> None:
        """Hears what `Feedback` tells a stream."""
        stream = self._stream()
        if stream is not None:
            stream.retransmits(rtx_ssrc, round_trip_s)

    def corrects(self, ssrc: int | None) -> None:
        """Hears what `Feedback` tells a stream."""
        stream = self._stream()
        if stream is not None:
            stream.corrects(ssrc)
