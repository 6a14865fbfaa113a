"""The video of several payloads on one UDP port, told apart by SSRC.

One thread takes datagrams and never waits for a decoder: each stream is put together and decoded on
a thread of its own, which PyAV lets run beside the others. Streams that nobody vouches for are
counted, held for a moment, and forgotten.
"""

from __future__ import annotations

import contextlib
import itertools
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from ground_station.stream import rtp
from ground_station.stream.arrivals import Flow
from ground_station.stream.assembly import Assembly, ReceivedFrame
from ground_station.stream.counters import Counters
from ground_station.stream.srtp import Unprotector
from ground_station.stream.udp import Address, bind, read
from pi_firmware.wire import rtcp
from pi_firmware.wire.srtcp import SrtcpProtector
from pi_firmware.wire.video import PORT

Owner = Callable[[int, str | None, float], str | None]
"""(SSRC, the payload whose key it was made with, seconds that it has come) -> its payload.

None: not known, or not taken. It is asked on the receiver's thread and has to return at once.
"""
OnFrame = Callable[[str, ReceivedFrame], None]
Send = Callable[[str, bytes, Address], None]
"""Sends RTCP to a payload at an address."""
_Source = tuple[int, str | None]
"""A stream's SSRC, and with keys the payload whose key it was made with."""

_POLL_S = 0.05
_HOLDING_POLL_S, _BUSY_POLL_S, _IDLE_POLL_S = 0.002, 0.01, 0.25
"""What is given up is given up at once: the IDR in its place is then one frame away and not two."""
_BUSY_NS = 200_000_000
_ASK_NS = 100_000_000
"""How often the owner of a stream that nobody vouched for is asked for again."""
_CANDIDATES = 8
_HELD_PACKETS = 512
"""Of a stream whose owner is not known yet: about a second, from its first packet on."""
_LEAP_S = 0.5
"""Packets of one stream come so much sooner than their times say, at most."""
_CANDIDATE_NS = 10_000_000_000
"""A candidate silent for so long is forgotten."""
_GIVE_WAY_NS = 500_000_000
"""A payload's earlier stream that is silent for so long gives way to its new one."""
_QUEUE_PACKETS = 2048
_SILENT_NS = 60_000_000_000
_ACCOUNTS = 64


class Stream:
    """One payload's stream, decoded on a thread of its own; what `Feedback` reports on."""

    def __init__(
        self,
        source: _Source,
        payload_id: str,
        port: int,
        counters: Counters,
        on_frame: OnFrame,
        send: Send,
    ) -> None:
        self.source = source
        self.ssrc, self.key_owner = source
        self.rtx_ssrc: int | None = None
        """What comes with it is sent again (RFC 4588); None: nothing is."""
        self.correction_ssrc: int | None = None
        """What comes with it corrects (RFC 5109); None: nothing does."""
        self.payload_id = payload_id
        self.port = port
        self.bytes = 0
        """Of the packets that came, as RTP."""
        self.failure = ""
        """Why its frames are not taken any more, in words."""
        self.last_ns = time.monotonic_ns()
        self._counters = counters
        self._assembly = Assembly(self.ssrc, counters)
        self._on_frame, self._send = on_frame, send
        self._address: Address | None = None
        self._sender_ssrc = 1 + secrets.randbelow(0xFFFFFFFF)
        self._waiting: deque[rtp.Packet] = deque()
        self._there = threading.Condition()
        self._decoding = self._closing = False
        name = f"video-{payload_id}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def counters(self) -> Counters:
        """A snapshot of the counters."""
        return replace(self._counters)

    def flow(self) -> Flow | None:
        """How it arrives of late; None before there is enough of it."""
        return self._assembly.arrivals.flow(time.monotonic_ns())

    @property
    def problem(self) -> str:
        """Why the stream cannot be shown, in words; "" while it can."""
        return self.failure or self._assembly.problem or ""

    @property
    def behind(self) -> bool:
        """Whether packets that came are not decoded yet."""
        return self._decoding or bool(self._waiting)

    def retransmits(self, rtx_ssrc: int | None, round_trip_s: float | None) -> None:
        """Takes with what SSRC its payload says that it sends again what is asked for; None: never.

        `round_trip_s`, to it and back, counts until retransmissions tell their own.
        """
        self.rtx_ssrc = rtx_ssrc
        retransmission = self._assembly.retransmission
        if round_trip_s is not None:
            retransmission.round_trip.hint(int(1e9 * round_trip_s), time.monotonic_ns())
        retransmission.offered = rtx_ssrc is not None

    def corrects(self, ssrc: int | None) -> None:
        """Takes with what SSRC its payload says that it sends corrections; None: never."""
        self.correction_ssrc = ssrc
        self._assembly.correction.offered = ssrc is not None

    def put(self, packet: rtp.Packet, address: Address | None = None) -> None:
        """Queues a packet; a stream that is decoded too slowly loses it, and nobody else does.

        What is missing is asked for at the `address` that the newest came from.
        """
        self.last_ns = packet.arrival_ns
        self._address = address or self._address
        self.bytes += len(packet.payload)
        with self._there:
            if len(self._waiting) >= _QUEUE_PACKETS:
                self._counters.overrun += 1
                return
            self._waiting.append(packet)
            self._there.notify()

    def end(self) -> None:
        """Decodes what waits and ends, by itself."""
        with self._there:
            self._closing = True
            self._there.notify()

    def join(self, timeout_s: float) -> None:
        """Waits for its end."""
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            wait_s = self._wait_s(time.monotonic_ns())
            with self._there:
                if not self._waiting and not self._closing:
                    self._there.wait(wait_s)
                packets, closing = list(self._waiting), self._closing
                self._decoding = bool(packets)
                self._waiting.clear()
            for packet in packets:
                self._give(self._assembly.push(packet))
            self._decoding = False
            # After the queue, so that a packet that waits in it is not given up.
            self._ask_for(self._assembly.retransmission.due(time.monotonic_ns()))
            self._give(self._assembly.expire(time.monotonic_ns()))
            if closing:
                return

    def _wait_s(self, now_ns: int) -> float:
        """The longest until something may have to be done without a packet."""
        wait_s = _BUSY_POLL_S if now_ns - self.last_ns < _BUSY_NS else _IDLE_POLL_S
        wait_s = _HOLDING_POLL_S if self._assembly.holds else wait_s
        due_ns = self._assembly.retransmission.next_ns()
        return wait_s if due_ns is None else min(wait_s, max(0, due_ns - now_ns) / 1e9)

    def _ask_for(self, sequences: list[int]) -> None:
        if sequences and self._address is not None:
            asked = rtcp.nack(self._sender_ssrc, self.ssrc, sequences)
            self._send(self.payload_id, asked, self._address)

    def _give(self, frames: Iterable[ReceivedFrame]) -> None:
        try:
            for frame in frames:
                self._on_frame(self.payload_id, frame)
        except Exception as error:  # one payload's trouble is not to end its stream
            self.failure = f"{type(error).__name__}: {error}"
        else:
            self.failure = ""


@dataclass
class _Candidate:
    """A stream that nobody has vouched for: its first packets, held for when somebody does."""

    first_ns: int
    last_ns: int
    asked_ns: int = 0
    packets: deque[rtp.Packet] = field(default_factory=deque)
    address: Address | None = None

    @property
    def continuous(self) -> bool:
        """Whether two packets in a row came: random bytes can look like one, not like two."""
        numbers = [packet.sequence for packet in self.packets]
        return any((a + 1) & 0xFFFF == b for a, b in itertools.pairwise(numbers))


def _of_now(packets: Iterable[rtp.Packet]) -> list[rtp.Packet]:
    """The packets of a stream that begins, without what came before this receiver was there.

    Recorded from the air and sent again, it is authentic, and none of it came here yet. But the
    stream's own time leaps where it ends and what is sent now begins, and falls back from there;
    the air's may stand still meanwhile.
    """
    kept: list[rtp.Packet] = []
    newest: rtp.Packet | None = None
    for packet in packets:
        if newest is not None:
            ticks = (packet.timestamp - newest.timestamp + (1 << 31)) % (1 << 32) - (1 << 31)
            later_s, came_s = ticks / rtp.CLOCK_HZ, 1e-9 * (packet.came_ns - newest.came_ns)
            if later_s < -_LEAP_S:
                continue
            if later_s > _LEAP_S and later_s - came_s > _LEAP_S:
                kept.clear()
        kept.append(packet)
        if newest is None or ticks > 0:
            newest = packet
    return kept


class MultiStreamReceiver:
    """Receives the video of up to `max_streams` payloads at a port; a context manager.

    `owner` says whose a stream is; `on_frame` gets each frame with its payload's id, on that
    stream's own thread, and must not wait. A payload has one stream at a time: another that is its
    own, too, is taken once the one before has been silent for half a second, with what was held
    of it. With `srtp_keys` (30 bytes by payload id) only SRTP of these payloads is looked at.

    Of a stream whose payload `retransmits` it asks for what is missing, from the same port.

    Raises `StreamError` with one line when the port is in use. `port` 0 takes a free one.
    """

    def __init__(
        self,
        port: int = PORT,
        host: str = "127.0.0.1",
        *,
        owner: Owner,
        on_frame: OnFrame,
        max_streams: int = 16,
        srtp_keys: Mapping[str, bytes] | None = None,
    ) -> None:
        self._owner, self._on_frame, self._max_streams = owner, on_frame, max_streams
        self._counters = Counters()
        self._unprotector = None if srtp_keys is None else Unprotector(srtp_keys, self._counters)
        self._protectors = {
            payload_id: SrtcpProtector(payload_id, key)
            for payload_id, key in (srtp_keys or {}).items()
        }
        self._streams: dict[_Source, Stream] = {}
        self._candidates: dict[_Source, _Candidate] = {}
        self._accounts: dict[_Source, Counters] = {}
        self._changed = threading.Lock()
        self._closing = threading.Event()
        self.failure = ""
        """Why nothing is received any more; "" while it is."""
        self._socket = bind(host, port, _POLL_S)
        self.host, self.port = self._socket.getsockname()[:2]
        self._thread = threading.Thread(target=self._run, name="video-receiver", daemon=True)
        self._thread.start()

    def __enter__(self) -> MultiStreamReceiver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops receiving; what has come is decoded before."""
        self._closing.set()
        self._thread.join()
        self._socket.close()
        for source in list(self._candidates):
            self._forget(source)
        for stream in self.streams():
            stream.end()
        for stream in self.streams():
            stream.join(2.0)

    @property
    def counters(self) -> Counters:
        """Of the port: `garbage`, `refused`, `replayed`, and datagrams of `other_streams`."""
        return replace(self._counters)

    @property
    def encrypted(self) -> bool:
        """Whether only SRTP is taken."""
        return self._unprotector is not None

    def streams(self) -> list[Stream]:
        """Those being received."""
        with self._changed:
            return list(self._streams.values())

    def stream_of(self, payload_id: str) -> Stream | None:
        """A payload's stream; None while there is none."""
        found = (stream for stream in self.streams() if stream.payload_id == payload_id)
        return next(found, None)

    def behind(self, ssrc: int) -> bool:
        """Whether something came of a stream that is held or not decoded yet."""
        streams = (stream.behind for stream in self.streams() if stream.ssrc == ssrc)
        return any(source[0] == ssrc for source in list(self._candidates)) or any(streams)

    def _run(self) -> None:
        try:
            self._receive()
        except Exception as error:
            self.failure = f"the receiver failed: {error!r}"
            raise

    def _receive(self) -> None:
        tidied_ns = 0
        while not self._closing.is_set():
            datagram: bytes | None = None
            try:
                datagram, waited_ns, address = read(self._socket)
            except TimeoutError:
                pass
            except OSError:
                continue  # an ICMP error of someone else's datagram
            now_ns = time.monotonic_ns()
            if datagram is not None:
                self._take(datagram, now_ns, waited_ns, address)
            if now_ns - tidied_ns >= _ASK_NS:
                tidied_ns = now_ns
                self._tidy(now_ns)

    def _take(self, datagram: bytes, now_ns: int, waited_ns: int, address: Address) -> None:
        key_owner = None
        if self._unprotector is not None:
            plain = self._unprotector.unprotect(datagram)
            if plain is None:
                return
            datagram, key_owner = plain, self._unprotector.sender
        packet = rtp.parse(datagram, now_ns, waited_ns)
        if packet is None:
            self._counters.garbage += 1
            return
        source = packet.ssrc, key_owner
        is_beside = packet.again or packet.corrects
        stream = self._beside(packet, source) if is_beside else self._streams.get(source)
        if stream is not None:
            stream.put(packet, address)
        elif is_beside:
            self._counters.other_streams += 1
        else:
            self._hold(source, packet, address)

    def _beside(self, packet: rtp.Packet, source: _Source) -> Stream | None:
        """The stream of a retransmission or correction, if its payload sent it; None otherwise."""
        for stream in self._streams.values():
            ssrc = stream.rtx_ssrc if packet.again else stream.correction_ssrc
            if source == (ssrc, stream.key_owner):
                return stream
        return None

    def _send(self, payload_id: str, asked: bytes, address: Address) -> None:
        """Sends RTCP to a payload, from any thread; with keys only as SRTCP."""
        if self._unprotector is not None:
            protector = self._protectors.get(payload_id)
            if protector is None:
                return
            asked = protector.protect(asked)
        with contextlib.suppress(OSError):  # closed meanwhile, or its network is gone
            self._socket.sendto(asked, socket.MSG_DONTWAIT, address)

    def _hold(self, source: _Source, packet: rtp.Packet, address: Address) -> None:
        """Keeps a stranger's packet; beyond the limits the oldest is another stream's datagram."""
        now_ns = packet.arrival_ns
        candidate = self._candidates.get(source)
        if candidate is None:
            if len(self._candidates) >= _CANDIDATES:
                # Whoever has shown the least goes first: random SSRCs push out one another.
                least = min(
                    self._candidates, key=lambda known: len(self._candidates[known].packets)
                )
                self._forget(least)
            candidate = self._candidates[source] = _Candidate(now_ns, now_ns)
        candidate.last_ns = now_ns
        candidate.packets.append(packet)
        candidate.address = address
        if len(candidate.packets) > _HELD_PACKETS:
            candidate.packets.popleft()
            self._counters.other_streams += 1
        if now_ns - candidate.asked_ns >= _ASK_NS:
            self._ask(source, candidate, now_ns)

    def _ask(self, source: _Source, candidate: _Candidate, now_ns: int) -> None:
        """Begins the stream if somebody vouches for it now."""
        candidate.asked_ns = now_ns
        age_s = (now_ns - candidate.first_ns) / 1e9 if candidate.continuous else 0.0
        ssrc, key_owner = source
        owner = self._owner(ssrc, key_owner, age_s)
        if owner is None or key_owner not in (None, owner):
            return
        if not self._make_room(owner, now_ns):
            return
        del self._candidates[source]
        counters = self._accounts.pop(source, None) or Counters()
        self._accounts[source] = counters
        if len(self._accounts) > _ACCOUNTS:
            del self._accounts[next(iter(self._accounts))]
        stream = Stream(source, owner, self.port, counters, self._on_frame, self._send)
        with self._changed:
            self._streams[source] = stream
        # Without keys anybody can send anything, and a replay's time leaps and stands still.
        packets = [*candidate.packets] if key_owner is None else _of_now(candidate.packets)
        self._counters.replayed += len(candidate.packets) - len(packets)
        for packet in packets:
            stream.put(packet, candidate.address)

    def _make_room(self, owner: str, now_ns: int) -> bool:
        """Whether a payload's new stream can be taken: its earlier one has gone, or goes now."""
        streams = self.streams()
        going = [stream for stream in streams if stream.payload_id == owner]
        if not going and len(streams) >= self._max_streams:
            going = [min(streams, key=lambda stream: stream.last_ns)]
        if any(now_ns - stream.last_ns < _GIVE_WAY_NS for stream in going):
            return False
        for stream in going:
            self._drop(stream)
        return True

    def _drop(self, stream: Stream) -> None:
        with self._changed:
            self._streams.pop(stream.source, None)
        stream.end()

    def _forget(self, source: _Source) -> None:
        self._counters.other_streams += len(self._candidates.pop(source).packets)

    def _tidy(self, now_ns: int) -> None:
        """Asks for the strangers again, and lets go of who has been silent for long."""
        for source, candidate in list(self._candidates.items()):
            if now_ns - candidate.last_ns > _CANDIDATE_NS:
                self._forget(source)
            elif now_ns - candidate.asked_ns >= _ASK_NS:
                self._ask(source, candidate, now_ns)
        for stream in self.streams():
            if now_ns - stream.last_ns > _SILENT_NS:
                self._drop(stream)
            else:
                self._rename(stream)

    def _rename(self, stream: Stream) -> None:
        """A stream that was taken for another's, or nobody's, goes on as who says it is its own."""
        owner = self._owner(stream.ssrc, stream.key_owner, 0.0)
        taken = {other.payload_id for other in self.streams()}
        if owner is not None and owner not in taken and stream.key_owner in (None, owner):
            stream.payload_id = owner
