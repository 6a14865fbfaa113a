"""The video's receiver: RTP from UDP into frames that keep their capture time.

One thread takes datagrams, decodes, and fills a bounded queue that drops its oldest frame. What it
hands out is only what the payload sent: no frame painted over a loss, none without capture time.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ground_station.recording.frames import plausible_exposure_s
from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from ground_station.stream.decoder import Decoder
from ground_station.stream.srtp import Unprotector
from pi_firmware.wire import sei
from pi_firmware.wire.annexb import NO_PARAMETER_SETS
from pi_firmware.wire.errors import StreamError
from pi_firmware.wire.video import PORT

_BUFFER_BYTES = 4 << 20
_SO_RCVBUFFORCE = 33  # Linux, not in Python's socket module
_POLL_S = 0.02
_SILENCE_NS = 2_000_000_000
_CANDIDATES = 8


@dataclass(frozen=True)
class ReceivedFrame:
    """One frame as captured.

    `time_ns` is the camera's capture time, `clock_ns` the payload's clock then, `arrival_ns` this
    machine's wall clock (`time.time_ns`) when the frame's last packet arrived. `image` is uint8,
    gray (H, W) or, from a receiver with `color`, BGR (H, W, 3). `exposure_s` is None where the
    payload does not tell it or what it tells cannot be.
    """

    image: NDArray[np.uint8]
    sequence: int
    time_ns: int
    clock_ns: int
    arrival_ns: int
    entropy_bits: float
    sharpness: float
    exposure_s: float | None
    gain: float | None
    heartbeat: bool
    ssrc: int


class _Stream:
    """What belongs to one SSRC from its first packet to its last."""

    def __init__(self, ssrc: int, payload_id: str | None, counters: Counters, color: bool) -> None:
        self.ssrc = ssrc
        self.payload_id = payload_id
        self.reorderer = rtp.Reorderer(counters)
        self.depacketizer = rtp.Depacketizer(counters)
        self.decoder = Decoder(counters, color=color)
        self.first_arrival_ns: int | None = None
        self.last_arrival_ns = 0


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
        parameter_sets_timeout_s: float = 3.0,
        srtp_keys: Mapping[str, bytes] | None = None,
    ) -> None:
        self._wanted_ssrc = ssrc
        self._color = color
        self._sets_timeout_ns = int(parameter_sets_timeout_s * 1e9)
        self._queue: deque[ReceivedFrame] = deque()
        self._queue_frames = queue_frames
        self._ready = threading.Condition()
        self._counters = Counters()
        self._unprotector: Unprotector | None = None
        if srtp_keys is not None:
            self._unprotector = Unprotector(srtp_keys, self._counters, ssrc=ssrc)
        self._stream: _Stream | None = None
        self._candidates: dict[int, rtp.Packet] = {}
        self._problem: str | None = None
        self._closing = threading.Event()
        self._socket = _bind(host, port)
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
            try:
                datagram: bytes | None = self._socket.recv(65535)
            except TimeoutError:
                datagram = None
            except OSError:
                continue  # an ICMP error of someone else's datagram
            now_ns = time.monotonic_ns()
            if datagram is not None:
                packet = self._parse(datagram, now_ns)
                if packet is not None:
                    for own in self._select(packet):
                        self._take(own)
            self._expire(now_ns)

    def _parse(self, datagram: bytes, arrival_ns: int) -> rtp.Packet | None:
        """The packet in a datagram, authentic where that is asked for; if none, it is counted."""
        if self._unprotector is not None:
            plain = self._unprotector.unprotect(datagram)
            if plain is None:
                return None
            datagram = plain
        packet = rtp.parse(datagram, arrival_ns)
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

    def _begin(self, ssrc: int) -> _Stream:
        owner = self._unprotector.payload_id(ssrc) if self._unprotector else None
        return _Stream(ssrc, owner, self._counters, self._color)

    def _take(self, packet: rtp.Packet) -> None:
        stream = self._stream
        assert stream is not None
        self._counters.packets += 1
        stream.last_arrival_ns = packet.arrival_ns
        if stream.first_arrival_ns is None:
            stream.first_arrival_ns = packet.arrival_ns
        for ordered, gap in stream.reorderer.push(packet):
            self._assemble(stream, ordered, gap)

    def _expire(self, now_ns: int) -> None:
        stream = self._stream
        if stream is None or stream.first_arrival_ns is None:
            return
        for ordered, gap in stream.reorderer.expire(now_ns):
            self._assemble(stream, ordered, gap)
        if stream.decoder.saw_parameter_sets:
            self._problem = None
        elif stream.last_arrival_ns - stream.first_arrival_ns > self._sets_timeout_ns:
            self._tell_problem(NO_PARAMETER_SETS)

    def _assemble(self, stream: _Stream, packet: rtp.Packet, gap: bool) -> None:
        for unit in stream.depacketizer.push(packet, gap):
            self._counters.access_units += 1
            image = stream.decoder.decode(unit)
            if image is None:
                continue
            info = sei.find(unit.data)
            if info is None:
                self._counters.unstamped += 1
                continue
            self._counters.decoded += 1
            since_ns = time.monotonic_ns() - unit.arrival_ns
            self._deliver(_frame(image, info, time.time_ns() - since_ns, stream.ssrc))

    def _deliver(self, frame: ReceivedFrame) -> None:
        with self._ready:
            self._queue.append(frame)
            if len(self._queue) > self._queue_frames:
                self._queue.popleft()
                self._counters.dropped += 1
            self._ready.notify()


def _frame(
    image: NDArray[np.uint8], info: sei.FrameInfo, arrival_ns: int, ssrc: int
) -> ReceivedFrame:
    return ReceivedFrame(
        image=image,
        sequence=info.sequence,
        time_ns=info.time_ns,
        clock_ns=info.clock_ns,
        arrival_ns=arrival_ns,
        entropy_bits=info.entropy_bits,
        sharpness=info.sharpness,
        exposure_s=plausible_exposure_s(info.exposure_s),
        gain=info.gain,
        heartbeat=info.heartbeat,
        ssrc=ssrc,
    )


def _bind(host: str, port: int) -> socket.socket:
    """A UDP socket with room for a burst; raises `StreamError` with one line."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        receiver = socket.socket(family, socket.SOCK_DGRAM)
    except OSError as error:
        raise StreamError(f"video on {host} port {port}: {error.strerror or error}") from None
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        with contextlib.suppress(OSError):  # beyond the system's limit, where we may
            receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
        receiver.bind(address)
    except OSError as error:
        receiver.close()
        raise StreamError(f"video on {host} port {port}: {error.strerror or error}") from None
    receiver.settimeout(_POLL_S)
    return receiver
