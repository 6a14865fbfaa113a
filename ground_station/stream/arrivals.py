"""How one stream's packets arrive: how many bits a second, after what queue, and what overflowed.

The queue of a link is what most frames take longer than the fastest of late. RTP timestamps count
from the capture, on a clock of the payload's that never steps.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from ground_station.stream.rtp import CLOCK_HZ, HEADER_BYTES, MAX_JUMP, Packet
from pi_firmware.wire.delay import WINDOW_NS, StandingDelay

LOSS_NS = 1_000_000_000
_SILENCE_NS = 150_000_000
"""What is missing after so long without any packet fell to an outage and to no overflow."""
_OVERTAKEN_NS = 50_000_000
_MOST_MISSING = 512
_ENOUGH = 10
"""Of so many packets one has the size of the largest that are sent, if such come through."""
_JUMP_NS = 10_000_000_000
_FLAT_NS = 15_000_000
_FLAT_FOR_NS = 3_000_000_000


@dataclass(frozen=True)
class Flow:
    """A stream of late; None where nothing came to measure it by.

    `received_kbps` are the payloads of its packets, each once, and of its corrections;
    `retransmitted_kbps` of them are of packets that were sent again. `queue_s` is what frames
    waited on the way, `dropped` the share of packets, 0 to 1, that were lost while others came,
    whether recovered or not, and `burst` how many of these in a row. `largest_bytes` is of the
    largest packet of the last second, its header too, None for less than ten packets.
    """

    received_kbps: float
    queue_s: float | None
    dropped: float
    retransmitted_kbps: float = 0.0
    burst: float | None = None
    largest_bytes: int | None = None


@dataclass
class _Frame:
    arrival_ns: int
    delay_ns: int
    """Of its first packet, above an unknown constant."""
    bytes: int = 0


class Arrivals:
    """Takes the packets of one SSRC as they come, in any order; tells the `flow` on any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._highest: int | None = None
        self._began_ns = self._last_ns = 0
        self._packets: deque[tuple[int, int]] = deque()  # arrival, bytes; of LOSS_NS
        self._again: deque[tuple[int, int]] = deque()  # the same of what was sent again
        self._corrections: deque[tuple[int, int]] = deque()
        self._missing: dict[int, int] = {}  # sequence number, when it was missed; of LOSS_NS
        self._forget_delays()

    def _forget_delays(self) -> None:
        self._timestamp: int | None = None
        self._ticks = 0
        self._frames: deque[_Frame] = deque()
        self._delay = StandingDelay()

    def add(self, packet: Packet) -> None:
        """Takes one packet; a duplicate and one that was not missed change nothing."""
        with self._lock:
            if packet.again or packet.corrects:  # of the link's load, and of nothing else
                beside = self._again if packet.again else self._corrections
                beside.append((packet.came_ns, len(packet.payload)))
                self._forget(packet.came_ns)
                return
            if not self._is_new(packet):
                return
            self._last_ns = packet.came_ns
            self._packets.append((packet.came_ns, len(packet.payload)))
            if packet.sequence == self._highest:
                self._time(packet)
            self._forget(packet.came_ns)

    def flow(self, now_ns: int) -> Flow | None:
        """The stream up to now, on the clock of the packets' arrival; None before it began."""
        with self._lock:
            self._forget(now_ns)
            if self._highest is None or now_ns - self._began_ns < WINDOW_NS // 2:
                return None
            span_ns = min(WINDOW_NS, now_ns - self._began_ns)
            size, again, corrections = (
                sum(size for at_ns, size in packets if now_ns - at_ns < span_ns)
                for packets in (self._packets, self._again, self._corrections)
            )
            missed = sum(now_ns - at_ns >= _OVERTAKEN_NS for at_ns in self._missing.values())
            runs = sum((number - 1) & 0xFFFF not in self._missing for number in self._missing)
            sent = len(self._packets) + missed
            return Flow(
                received_kbps=(size + again + corrections) * 8e6 / span_ns,
                queue_s=self._queue_s(now_ns),
                dropped=missed / sent if self._packets else 0.0,
                retransmitted_kbps=again * 8e6 / span_ns,
                burst=len(self._missing) / runs if runs else None,
                largest_bytes=HEADER_BYTES + max(size for _, size in self._packets)
                if len(self._packets) >= _ENOUGH
                else None,
            )

    def _is_new(self, packet: Packet) -> bool:
        """Whether it was not here before; notes what is missing before it."""
        now_ns = packet.came_ns
        ahead = 0 if self._highest is None else (packet.sequence - self._highest) & 0xFFFF
        if self._highest is None or MAX_JUMP < ahead < 0x10000 - MAX_JUMP:
            self._begin()
            self._began_ns, self._highest = now_ns, packet.sequence
            return True
        if ahead == 0 or ahead > MAX_JUMP:
            return self._missing.pop(packet.sequence, None) is not None
        if now_ns - self._last_ns <= _SILENCE_NS:
            for back in range(min(ahead - 1, _MOST_MISSING), 0, -1):
                self._missing[(packet.sequence - back) & 0xFFFF] = now_ns
            while len(self._missing) > _MOST_MISSING:
                del self._missing[next(iter(self._missing))]
        self._highest = packet.sequence
        return True

    def _time(self, packet: Packet) -> None:
        """Takes the time that the newest packet, if it is a frame's first one here, was under way.

        A frame's later packets wait for its own earlier ones, which is no queue yet.
        """
        now_ns = packet.came_ns
        if packet.timestamp == self._timestamp:
            self._frames[-1].bytes += len(packet.payload)
            return
        if self._timestamp is not None:
            step = (packet.timestamp - self._timestamp) & 0xFFFFFFFF
            step -= (step & 0x80000000) << 1
            apart_ns = now_ns - self._frames[-1].arrival_ns - step * 10**9 // CLOCK_HZ
            if abs(apart_ns) > _JUMP_NS:  # no queue: the sender's clock is another now
                self._forget_delays()
            else:
                self._ticks += step
        self._timestamp = packet.timestamp
        delay_ns = now_ns - self._ticks * 10**9 // CLOCK_HZ
        self._frames.append(_Frame(now_ns, delay_ns, len(packet.payload)))
        self._delay.add(now_ns, delay_ns)

    def _forget(self, now_ns: int) -> None:
        """Lets go of what is too old; of the delays the last ones stay, to go on from."""
        for packets in (self._packets, self._again, self._corrections):
            while packets and now_ns - packets[0][0] >= LOSS_NS:
                packets.popleft()
        while self._missing:
            oldest = next(iter(self._missing))
            if now_ns - self._missing[oldest] < LOSS_NS:
                break
            del self._missing[oldest]
        while len(self._frames) > 1 and now_ns - self._frames[0].arrival_ns >= _FLAT_FOR_NS:
            self._frames.popleft()

    def _queue_s(self, now_ns: int) -> float | None:
        if self._is_the_ways_own(now_ns):
            least_ns = min(frame.delay_ns for frame in self._frames)
            self._delay.rebase(self._frames[-1].arrival_ns, least_ns)
        return self._delay.standing_s(now_ns)

    def _is_the_ways_own(self, now_ns: int) -> bool:
        """Whether the delay stays as it is although clearly less was sent: then it is no queue.

        The way is another now, or somebody else fills it. A queue of ours would have drained.
        """
        parts: dict[int, list[_Frame]] = {}
        for frame in self._frames:
            part = (now_ns - frame.arrival_ns) * 6 // _FLAT_FOR_NS
            parts.setdefault(part, []).append(frame)
        if not set(range(6)) <= set(parts):
            return False
        least = [min(frame.delay_ns for frame in parts[part]) for part in range(6)]
        base_ns = self._delay.base_ns or 0
        if max(least) - min(least) > _FLAT_NS or min(least) - base_ns < _FLAT_NS:
            return False
        late, early = (sum(f.bytes for p in pair for f in parts[p]) for pair in ((0, 1), (4, 5)))
        return late < 0.8 * early
