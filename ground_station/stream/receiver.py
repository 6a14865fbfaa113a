"""One payload's video: RTP from UDP into frames that keep their capture time.

One thread takes datagrams, decodes, and fills a bounded queue that drops its oldest frame. What it
hands out is only what the payload sent: no frame painted over a loss, none without capture time.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace

from ground_station.stream import rtp
from ground_station.stream.arrivals import Flow
from ground_station.stream.assembly import SETS_TIMEOUT_S, Assembly, ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.srtp import Unprotector
from ground_station.stream.udp import bind, read
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.video import PORT

__all__ = ["ReceivedFrame", "Receiver"]

_POLL_S = 0.02
_SILENCE_NS = 2_000_000_000
_CANDIDATES = 8


class Receiver:
    """Receives one payload's video; a context manager.

    It takes the stream with `ssrc`, or locks onto the first one that sends two packets in a row; a
    stream that has been silent for 2 s gives way to the next. Raises `StreamError` with one line
    when the port is in use. `port` 0 takes a free one, which `.port` then tells.

    With `srtp_keys`, master keys with salt (30 bytes) by payload id, it takes SRTP of these
    payloads and nothing else. Give `ssrc`, too, as telemetry announces it: the video of an earlier
    flight, played back, is authentic as well.
    """

    def __init__(
        self,
        port: int = PORT,
        host: str = "127.0.0.1",
        *,
        queue_frames: int = 4,
        ssrc: int | None = None,
        color: bool = False,
        parameter_sets_timeout_s: float = SETS_TIMEOUT_S,
        srtp_keys: Mapping[str, bytes] | None = None,
    ) -> None:
        self._wanted_ssrc = ssrc
        self._color = color
        self._sets_timeout_s = parameter_sets_timeout_s
        self._queue: deque[ReceivedFrame] = deque()
        self._queue_frames = queue_frames
        self._ready = threading.Condition()
        self._counters = Counters()
        self._unprotector: Unprotector | None = None
        if srtp_keys is not None:
            self._unprotector = Unprotector(srtp_keys, self._counters, ssrc=ssrc)
        self._stream: Assembly | None = None
        self._candidates: dict[int, rtp.Packet] = {}
        self._problem: str | None = None
        self._closing = threading.Event()
        self._socket = bind(host, port, _POLL_S)
        self.host, self.port = self._socket.getsockname()[:2]
        self._thread = threading.Thread(target=self._run, name="video-receiver", daemon=True)
        self._thread.start()

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops receiving; frames still queued can be taken."""
        self._closing.set()
        self._thread.join()
        self._socket.close()
        with self._ready:
            self._ready.notify_all()

    def get(self, timeout_s: float = 1.0) -> ReceivedFrame | None:
        """The oldest frame in the queue, or None when none comes in time.

        Raises `StreamError` when the stream cannot be decoded: it has been coming for
        `parameter_sets_timeout_s` without parameter sets.
        """
        with self._ready:
            self._ready.wait_for(
                lambda: self._queue or self._problem or self._closing.is_set(), timeout_s
            )
            if self._queue:
                return self._queue.popleft()
            if self._problem:
                raise StreamError(f"video on port {self.port}: {self._problem}")
            return None

    @property
    def counters(self) -> Counters:
        """A snapshot of the counters."""
        return replace(self._counters)

    def flow(self) -> Flow | None:
        """How the stream arrives of late; None before there is one."""
        stream = self._stream
        return stream.arrivals.flow(time.monotonic_ns()) if stream else None

    @property
    def ssrc(self) -> int | None:
        """The SSRC of the stream being received; None before there is one."""
        stream = self._stream
        return stream.ssrc if stream else None

    @property
    def payload_id(self) -> str | None:
        """Whose stream it is, by its key; None before there is one, or without keys."""
        stream = self._stream
        return stream.payload_id if stream else None

    @property
    def problem(self) -> str | None:
        """Why the stream cannot be shown, in words; None while it can."""
        return self._problem

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:  # whoever waits for frames must hear of it
            self._tell_problem(f"the receiver failed: {error!r}")
            raise

    def _tell_problem(self, problem: str) -> None:
        with self._ready:
            self._problem = problem
            self._ready.notify_all()

    def _receive(self) -> None:
        while not self._closing.is_set():
            datagram: bytes | None = None
            try:
                datagram, waited_ns = read(self._socket)
            except TimeoutError:
                pass
            except OSError:
                continue  # an ICMP error of someone else's datagram
            now_ns = time.monotonic_ns()
            if datagram is not None:
                packet = self._parse(datagram, now_ns, waited_ns)
                if packet is not None:
                    for own in self._select(packet):
                        assert self._stream is not None
                        self._deliver(self._stream.push(own))
            if self._stream is not None:
                self._watch(self._stream, now_ns)

    def _parse(self, datagram: bytes, arrival_ns: int, waited_ns: int) -> rtp.Packet | None:
        """The packet in a datagram, authentic where that is asked for; if none, it is counted."""
        if self._unprotector is not None:
            plain = self._unprotector.unprotect(datagram)
            if plain is None:
                return None
            datagram = plain
        packet = rtp.parse(datagram, arrival_ns, waited_ns)
        if packet is None:
            self._counters.garbage += 1
        return packet

    def _select(self, packet: rtp.Packet) -> list[rtp.Packet]:
        """The packets to take now that this one is here; locks onto a stream when there is none."""
        stream = self._stream
        if stream is not None and packet.ssrc == stream.ssrc:
            return [packet]
        silent = stream is None or packet.arrival_ns - stream.last_arrival_ns > _SILENCE_NS
        if self._wanted_ssrc is not None:
            if packet.ssrc != self._wanted_ssrc:
                self._counters.other_streams += 1
                return []
            self._stream = self._begin(packet.ssrc)
            return [packet]
        if not silent:
            self._counters.other_streams += 1
            return []
        # Random bytes can look like one packet of a stream, but not like two in a row.
        before = self._candidates.pop(packet.ssrc, None)
        if before is not None and packet.sequence == (before.sequence + 1) & 0xFFFF:
            self._counters.other_streams += len(self._candidates)
            self._candidates.clear()
            self._stream = self._begin(packet.ssrc)
            return [before, packet]
        self._candidates[packet.ssrc] = packet
        if len(self._candidates) > _CANDIDATES:
            del self._candidates[next(iter(self._candidates))]
            self._counters.other_streams += 1
        return []

    def _begin(self, ssrc: int) -> Assembly:
        return Assembly(
            ssrc,
            self._counters,
            payload_id=self._unprotector.payload_id(ssrc) if self._unprotector else None,
            color=self._color,
            sets_timeout_s=self._sets_timeout_s,
        )

    def _watch(self, stream: Assembly, now_ns: int) -> None:
        """Gives up what is missing too long, and a stream that cannot be shown."""
        self._deliver(stream.expire(now_ns))
        if (problem := stream.problem) is not None:
            self._tell_problem(problem)
        else:
            self._problem = None

    def _deliver(self, frames: Iterable[ReceivedFrame]) -> None:
        for frame in frames:
            with self._ready:
                self._queue.append(frame)
                if len(self._queue) > self._queue_frames:
                    self._queue.popleft()
                    self._counters.dropped += 1
                self._ready.notify()
