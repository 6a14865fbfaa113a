"""Who else speaks to the ground station and the payload, and not as agreed."""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numbered_flight import encoded, packets, stamped
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from pi_firmware.wire import messages
from pi_firmware.wire.errors import BlimpError
from pi_firmware.wire.telemetry import Session, open_session
from scenarios.background import Background
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World

_TIMEOUT_S = 2.0


class Peer(Step):
    """Base of steps in which somebody does something again and again."""

    def begin(self, world: World) -> Background:
        """Who does it, not started yet."""
        raise NotImplementedError

    def inject(self, world: World) -> None:
        try:
            world.kept[id(self)] = self.begin(world).start()
        except BlimpError as error:  # the service may be down at this moment
            world.say(f"{type(self).__name__}: {error}")

    def lacking(self, world: World) -> str:
        peer = world.kept.get(id(self))
        if peer is None:
            return "nobody came"
        return f"after {peer.acts} times: {peer.failure}" if peer.failure or not peer.acts else ""

    def fix(self, world: World) -> None:
        peer = world.kept.pop(id(self), None)
        if peer is None:
            return
        peer.end()
        world.say(f"{type(self).__name__}: {peer.acts} times, {peer.failure or 'all sent'}")


def _client(world: World, certificates: Path) -> Session:
    """A session of a second program with some machine's certificate, linked with the station.

    With the station's own it is as `blimp command`'s: its words are handed on to the payloads.
    """
    return open_session(
        connect=[world.service.endpoint],
        certificates=certificates,
        client_timeout_s=_TIMEOUT_S,
    )


def _datagrams(world: World, next_one: Any, rate_hz: float) -> Background:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    to = ("127.0.0.1", world.service.video)

    def send() -> bool:
        datagram = next_one()
        if datagram is not None:
            with contextlib.suppress(ConnectionError):
                out.sendto(datagram, to)
                return True
        return False

    return Background(send, 1.0 / rate_hz).at_end(out.close)


@dataclass(frozen=True)
class Garbage(Peer):
    """Datagrams at the video's port that are no RTP, and halves of some."""

    rate_hz: float = 200.0

    def begin(self, world: World) -> Background:
        draw = world.draw()
        whole = packets([stamped(unit, k) for k, unit in enumerate(encoded(5))], ssrc=4711)

        def one() -> bytes:
            cut = draw.choice(whole)[: draw.randint(0, 60)]
            return draw.choice((draw.randbytes(draw.randint(0, 1400)), cut, b""))

        return _datagrams(world, one, self.rate_hz)


@dataclass(frozen=True)
class Stranger(Peer):
    """Another's video of the same payload type, whole, with an SSRC that nobody announced."""

    ssrc: int = 4711

    def begin(self, world: World) -> Background:
        units = [stamped(unit, k) for k, unit in enumerate(encoded(30))]
        datagrams = itertools.cycle(packets(units, ssrc=self.ssrc))
        return _datagrams(world, lambda: next(datagrams), 200.0)


@dataclass(frozen=True)
class OldPackets(Peer):
    """Packets of this flight come once more, up to `age_s` later."""

    age_s: float = 3.0

    def begin(self, world: World) -> Background:
        draw = world.draw()

        def one() -> bytes | None:
            recent = list(world.run.watch.recent)
            young_s = time.monotonic() - self.age_s
            old = [data for at_s, data in recent if young_s < at_s < young_s + self.age_s - 0.5]
            return draw.choice(old) if old else None

        return _datagrams(world, one, 50.0)


NONSENSE = ("", "null", "[]", "{", "\x00\xff", '{"schema": 3}', "[" * 3000, '{"a":' * 500)
"""JSON texts that are no message."""


def _twisted(draw: random.Random) -> tuple[str, bytes]:
    """A message's kind and text that is not as agreed, or a newer program's."""
    battery = json.loads(messages.encode(messages.Battery(time_ns=1, voltage=3.9)))
    twists: tuple[dict[str, Any], ...] = (
        {"voltage": float("nan")},
        {"voltage": float("inf")},
        {"voltage": 10**400},
        {"voltage": "full"},
        {"voltage": None},
        {"time_ns": -1},
        {"time_ns": 1 << 80},
        {"schema": "blimp.battery/2.0"},
        {"schema": "blimp.battery/0.9"},
        {"schema": "blimp.battery/1.99", "new_field": {"x": [1, 2]}},
        {"schema": "blimp.gate/1.0"},
        {"percentage": {}, "alarm": 7},
        {"filler": "x" * 300_000},
    )
    if draw.random() < 0.3:
        text = draw.choice(NONSENSE)
    else:
        text = json.dumps(battery | draw.choice(twists))
    return draw.choice(("battery", "gate", "event", "health", "autopilot", "pose", "bogus")), (
        text.encode("utf-8", "surrogatepass")
    )


@dataclass(frozen=True)
class BadTelemetry(Peer):
    """Messages that are not as agreed, from a second program with the payload's certificate.

    They are in its name, which is heard, in others' and in no one's, which must not be.
    """

    rate_hz: float = 50.0

    def begin(self, world: World) -> Background:
        draw = world.draw()
        session = _client(world, world.certificates)

        def act() -> bool:
            kind, text = _twisted(draw)
            who = draw.choice(("blimp-1", "blimp-1", "blimp-9", "NOT-A-NAME", "x" * 40))
            with contextlib.suppress(Exception):  # the service may be down at this moment
                session.zenoh.put(f"blimp/{who}/{kind}", text)
                return True
            return False

        return Background(act, 1.0 / self.rate_hz).at_end(session.close)


@dataclass(frozen=True)
class CommandFlood(Peer):
    """Many commands a second to the payload: asked for in vain, and IDR again and again."""

    rate_hz: float = 50.0

    def begin(self, world: World) -> Background:
        draw = world.draw()
        session = _client(world, world.service.certificates)
        bodies = (
            messages.encode(messages.Command(time_ns=1)),
            messages.encode(messages.Command(time_ns=1, arguments={"kbps": 1e9})),
            b'{"schema": "blimp.command/1.0", "time_ns": 1, "arguments": {"kbps": NaN}}',
            b"",
            b"[]",
        )

        def act() -> bool:
            name = draw.choice(("idr", "bitrate", "exposure", "bogus", "reboot"))
            key = f"blimp/blimp-1/command/{name}"
            with contextlib.suppress(Exception):
                session.zenoh.get(key, lambda _: None, payload=draw.choice(bodies), timeout=0.5)
                return True
            return False

        return Background(act, 1.0 / self.rate_hz).at_end(session.close)


@dataclass(frozen=True)
class SlowViewers(Step):
    """Dashboards that connect and never read what they are sent."""

    count: int = 4

    def inject(self, world: World) -> None:
        viewers: list[ClientConnection] = world.kept.setdefault(id(self), [])
        url = f"ws://127.0.0.1:{world.service.http}/api/live?payload=blimp-1"
        for _ in range(self.count):
            with contextlib.suppress(OSError, WebSocketException, TimeoutError):
                viewers.append(
                    connect(url, max_queue=1, open_timeout=_TIMEOUT_S, close_timeout=0.1)
                )
        world.say(f"SlowViewers: {len(viewers)} of {self.count} connected")

    def lacking(self, world: World) -> str:
        came = len(world.kept[id(self)])
        return f"{came} of {self.count} connected" if came < self.count else ""

    def fix(self, world: World) -> None:
        for viewer in world.kept.pop(id(self)):
            with contextlib.suppress(OSError):
                viewer.socket.close()


@dataclass(frozen=True)
class HostileHttp(Peer):
    """Requests that are none, never end, are far too large, or want what is not there."""

    rate_hz: float = 10.0

    def begin(self, world: World) -> Background:
        draw = world.draw()
        here = f"Host: 127.0.0.1:{world.service.http}\r\n"
        upgrade = (
            f"GET /api/live HTTP/1.1\r\n{here}Upgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        ).encode()
        post = f"POST /api/recording HTTP/1.1\r\n{here}Content-Type: application/json\r\n"
        kinds = (
            draw.randbytes(2000),
            b"GET / HTTP/1.1\r\n",
            b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\n\r\n",
            f"GET /../../etc/passwd HTTP/1.1\r\n{here}\r\n".encode(),
            f"{post}Content-Length: 99999999999\r\n\r\n{{".encode(),
            f"{post}Content-Length: 7\r\n\r\n{{'a':1}}".encode(),
            upgrade + b"\x81\xff" + b"\xff" * 8 + draw.randbytes(70_000),
            upgrade + draw.randbytes(3000),
        )
        held: list[socket.socket] = []

        def act() -> bool:
            came = len(held)
            with contextlib.suppress(OSError):
                one = socket.create_connection(("127.0.0.1", world.service.http), _TIMEOUT_S)
                held.append(one)  # it is kept open, and nothing is read from it
                one.settimeout(_TIMEOUT_S)
                one.sendall(draw.choice(kinds))
            connected = len(held) > came
            while len(held) > 20:
                held.pop(0).close()
            return connected

        def close() -> None:
            for one in held:
                one.close()

        return Background(act, 1.0 / self.rate_hz).at_end(close)
