"""A UDP relay that does to packets what Wi-Fi does, by a seed, and counts it exactly.

The kernel's netem is not everywhere. What happens to the n-th packet depends on the seed, on n and
on the impairment then in force, and on no clock: only outages, which last seconds, and the queue
before a limited rate follow the time.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import random
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

_BUFFER_BYTES = 8 << 20
_SO_RCVBUFFORCE = 33  # Linux, not in Python's socket module
_POLL_S = 0.05
_HOLD_LIMIT_S = 0.005
"""The longest that a packet waits for those that overtake it, so that a pause does not hold it."""


@dataclass(frozen=True)
class Impairment:
    """What a link does. Shares are of all packets, 0 to 1.

    Bursts are the Gilbert-Elliott model's: before each packet the link goes from good to bad with
    probability `burst_start`, back with `burst_end`, and a bad link loses the share `burst_loss`.
    """

    loss: float = 0.0
    burst_start: float = 0.0
    burst_end: float = 1.0
    burst_loss: float = 1.0
    reorder: float = 0.0
    reorder_by: int = 3  # later packets that overtake it
    duplicate: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0  # up to this much more, drawn for each packet
    rate_kbps: float = 0.0  # of the datagrams' own bytes; 0: unlimited
    queue_s: float = 0.5  # a packet that would wait longer for the rate is lost


CLEAN = Impairment()


@dataclass
class LinkCounts:
    """`received` = `passed` + `lost` once nothing waits; `duplicated` copies went out beside.

    Of the lost, `overflowed` found the queue before the limited rate full.
    """

    received: int = 0
    passed: int = 0
    lost: int = 0
    duplicated: int = 0
    delayed: int = 0  # of the passed: held back until others had overtaken, or for a time
    overflowed: int = 0


class Bottleneck:
    """A link that carries so much and no more: first come, first served, in a bounded queue."""

    def __init__(self) -> None:
        self._free_s = 0.0

    def wait_s(self, size: int, now_s: float, does: Impairment) -> float | None:
        """How long a packet of `size` bytes takes from now, waiting and sending; None: overflow."""
        if does.rate_kbps <= 0:
            return 0.0
        waits_s = max(0.0, self._free_s - now_s)
        if waits_s > does.queue_s:
            return None
        self._free_s = now_s + waits_s + size * 8 / (1e3 * does.rate_kbps)
        return self._free_s - now_s


@dataclass
class _Held:
    """A packet that others overtake."""

    overtakers: int
    until_s: float
    datagram: bytes
    copies: int
    delay_s: float


class ImpairedLink:
    """Relays datagrams from its own `port` on `host` to another on loopback; a context manager.

    `tap` is called for each datagram that comes, in order and before it goes on, with whether it is
    lost. Packets to a port where nobody listens count as passed, as they would on the air.
    `outages` are (at_s, for_s) from the first packet on, in which nothing passes. `port` 0 is a
    free one.

    What comes back goes to whoever sent last, after the same delay and with the same loss and
    outages, drawn apart: the fates of what comes do not depend on it. `returned` counts it.
    """

    def __init__(
        self,
        to_port: int,
        impairment: Impairment = CLEAN,
        *,
        seed: int = 0,
        tap: Callable[[bytes, bool], None] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        outages: Sequence[tuple[float, float]] = (),
    ) -> None:
        self._outages = tuple(outages)
        self._first_s: float | None = None
        self._bottleneck = Bottleneck()
        self._counts = LinkCounts()
        self._impairment = impairment
        self._random, self._random_back = random.Random(seed), random.Random(f"{seed} back")
        self._sender: Any = None
        self._back: list[tuple[float, int, bytes]] = []  # a heap by due time and number
        self.returned = 0
        self._tap = tap
        self._bad = False
        self._gone_until_s = 0.0
        self._held: list[_Held] = []
        self._waiting: list[tuple[float, int, bytes, int]] = []  # a heap by due time and number
        self._number = itertools.count()
        # Two sockets: an ICMP error from where nobody listens must not come back to the sender.
        self._in, self._out = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for option in (socket.SO_RCVBUF, _SO_RCVBUFFORCE):
            with contextlib.suppress(OSError):
                self._in.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
        self._in.bind((host, port))
        self.port: int = self._in.getsockname()[1]
        self.retarget(to_port)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="impaired-link", daemon=True)

    def __enter__(self) -> ImpairedLink:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Sends what still waits and ends; a second call does nothing."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._in.close()
        self._out.close()

    @property
    def counts(self) -> LinkCounts:
        """A snapshot of the counts."""
        return replace(self._counts)

    @property
    def first_s(self) -> float | None:
        """When the first packet came, on the monotonic clock; None before."""
        return self._first_s

    @property
    def idle(self) -> bool:
        """Whether all that came is accounted for, and nothing waits."""
        counts = self.counts
        return counts.received == counts.passed + counts.lost

    def impair(self, impairment: Impairment) -> None:
        """Does this to the packets from now on."""
        self._impairment = impairment

    def gone(self, seconds: float) -> None:
        """Loses all packets from now on for this long; returns at once."""
        self._gone_until_s = time.monotonic() + seconds

    def retarget(self, to_port: int) -> None:
        """Sends to this port from now on."""
        self._to = ("127.0.0.1", to_port)

    def _run(self) -> None:
        while not self._closing.is_set():
            ready, _, _ = select.select([self._in, self._out], [], [], self._wait_s())
            if self._in in ready:
                datagram, self._sender = self._in.recvfrom(65535)
                self._take(datagram)
            if self._out in ready:
                self._take_back(self._out.recv(65535))
            self._release(time.monotonic())
        self._release(float("inf"))

    def _wait_s(self) -> float:
        due_s = [held.until_s for held in self._held]
        due_s += [entry[0] for entry in (*self._waiting[:1], *self._back[:1])]
        return min(max(min(due_s) - time.monotonic(), 1e-4), _POLL_S) if due_s else _POLL_S

    def _take(self, datagram: bytes) -> None:
        now_s, does = time.monotonic(), self._impairment
        if self._first_s is None:
            self._first_s = now_s
        # As many draws for each packet, whatever becomes of it: the next ones' fates stay the same.
        turn, lost, burst, late, twice, jitter = (self._random.random() for _ in range(6))
        self._bad = turn >= does.burst_end if self._bad else turn < does.burst_start
        self._counts.received += 1
        drops = (
            lost < does.loss
            or (self._bad and burst < does.burst_loss)
            or now_s < self._gone_until_s
            or self._is_out(now_s - self._first_s)
        )
        # What is lost on the air has taken its time on it, too.
        queued_s = self._bottleneck.wait_s(len(datagram), now_s, does)
        if queued_s is None:
            drops = True
            self._counts.overflowed += 1
        if self._tap is not None:
            self._tap(datagram, drops)
        for held in self._held:
            held.overtakers -= 1
        if drops:
            self._counts.lost += 1
            return
        copies = 1 + (twice < does.duplicate)
        delay_s = (queued_s or 0.0) + does.delay_s + jitter * does.jitter_s
        if late < does.reorder:
            until_s = now_s + _HOLD_LIMIT_S
            self._held.append(_Held(does.reorder_by, until_s, datagram, copies, delay_s))
        else:
            self._go_on(datagram, copies, delay_s, now_s, delayed=delay_s > 0)

    def _take_back(self, datagram: bytes) -> None:
        now_s, does = time.monotonic(), self._impairment
        lost = self._random_back.random() < does.loss or now_s < self._gone_until_s
        if lost or (self._first_s is not None and self._is_out(now_s - self._first_s)):
            return
        heapq.heappush(self._back, (now_s + does.delay_s, next(self._number), datagram))

    def _is_out(self, since_s: float) -> bool:
        return any(at_s <= since_s < at_s + for_s for at_s, for_s in self._outages)

    def _release(self, now_s: float) -> None:
        """Sends what is due; all of it when `now_s` is infinite."""
        ready = [held for held in self._held if held.overtakers <= 0 or held.until_s <= now_s]
        self._held = [held for held in self._held if held not in ready]
        for held in ready:
            self._go_on(held.datagram, held.copies, held.delay_s, now_s, delayed=True)
        while self._waiting and self._waiting[0][0] <= now_s:
            _, _, datagram, copies = heapq.heappop(self._waiting)
            self._send(datagram, copies, delayed=True)
        while self._back and self._back[0][0] <= now_s:
            _, _, datagram = heapq.heappop(self._back)
            self._in.sendto(datagram, self._sender)
            self.returned += 1

    def _go_on(
        self, datagram: bytes, copies: int, delay_s: float, now_s: float, *, delayed: bool
    ) -> None:
        if delay_s > 0:
            entry = (now_s + delay_s, next(self._number), datagram, copies)
            heapq.heappush(self._waiting, entry)
        else:
            self._send(datagram, copies, delayed=delayed)

    def _send(self, datagram: bytes, copies: int, *, delayed: bool) -> None:
        for _ in range(copies):
            self._out.sendto(datagram, self._to)
        self._counts.duplicated += copies - 1
        self._counts.delayed += delayed
        self._counts.passed += 1
