"""Who else speaks to the ground station and the payload, and not as agreed."""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import resource
import socket
import ssl
import struct
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from intake_stand import eventually
from numbered_flight import encoded, packets, stamped
from soaking.processes import descriptors
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from pi_firmware.wire import messages
from pi_firmware.wire.errors import BlimpError
from scenarios import flood
from scenarios.background import Background
from scenarios.step import Step

if TYPE_CHECKING:
    from scenarios.world import World

_TIMEOUT_S = 2.0
_LEAST_FLOOD_HZ = 2000.0
"""On a machine that is busy, too: 20 Mbit/s."""
_GIVEN_BACK_S = 20.0
_SPARE_DESCRIPTORS = 3
_MORE_DESCRIPTORS = 10
"""What a process may have more after than before, with those who really look at it."""


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


def _datagrams(world: World, next_one: Any, rate_hz: float) -> Background:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    to = ("127.0.0.1", world.service.video)

    def send() -> bool:
        datagram = next_one()
        return datagram is not None and out.sendto(datagram, to) >= 0

    return Background(send, 1.0 / rate_hz, ConnectionError).at_end(out.close)


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


@dataclass(frozen=True)
class AirReplayed(Peer):
    """The station is killed and starts, and all the while what it was sent before comes again."""

    STARTS: ClassVar[bool] = True

    def begin(self, world: World) -> Background:
        world.hold_service(self)
        recorded = itertools.cycle([data for _, data in world.run.watch.recent])
        return _datagrams(world, lambda: next(recorded), 300.0)

    def inject(self, world: World) -> None:
        super().inject(world)
        world.let_service(self)


@dataclass(frozen=True)
class Flood(Step):
    """Datagrams at line rate: one of `flood.KINDS`."""

    kind: str = "garbage"

    def inject(self, world: World) -> None:
        told = world.folder / f"flood-{id(self)}.txt"
        port, ssrc = str(world.service.video), str(world.run.ssrc)
        with told.open("w") as out:
            command = [sys.executable, flood.__file__, port, self.kind, ssrc]
            world.kept[id(self)] = (subprocess.Popen(command, stdout=out), told)

    def lacking(self, world: World) -> str:
        flooding, told = world.kept[id(self)]
        if flooding.poll() is not None:
            return f"it ended with {flooding.returncode}"
        sent = int((told.read_text().split() or ["0"])[-1])
        rate_hz = sent / self.for_s
        world.say(f"Flood: {sent} datagrams, {rate_hz:.0f} a second")
        return "" if rate_hz > _LEAST_FLOOD_HZ else f"{rate_hz:.0f} datagrams a second only"

    def fix(self, world: World) -> None:
        flooding, _ = world.kept.pop(id(self))
        flooding.kill()
        flooding.wait()


@dataclass(frozen=True)
class Aborting(Peer):
    """Who begins to speak HTTP or TLS and resets the connection, after each number of bytes."""

    rate_hz: float = 50.0

    def begin(self, world: World) -> Background:
        ports = world.service.http, int(world.service.endpoint.rpartition(":")[2])
        host = f"Host: 127.0.0.1:{ports[0]}\r\n"
        recordings = sorted(path.name for path in world.service.recordings.glob("*.mcap"))
        whole = [
            (ports[0], f"GET /api/state HTTP/1.1\r\n{host}\r\n".encode()),
            (ports[1], _client_hello()),
        ]
        for name in recordings[:1]:
            request = f"GET /api/recordings/{name} HTTP/1.1\r\n{host}\r\n"
            whole.append((ports[0], request.encode()))
        tries = itertools.cycle(
            (port, data[: size % (len(data) + 1)]) for size in range(600) for port, data in whole
        )

        def abort() -> None:
            port, part = next(tries)
            with socket.create_connection(("127.0.0.1", port), _TIMEOUT_S) as one:
                one.sendall(part)
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

        world.kept[-id(self)] = self._open(world)
        return Background(abort, 1.0 / self.rate_hz, OSError)

    def fix(self, world: World) -> None:
        super().fix(world)
        before = world.kept.pop(-id(self), None)

        def given_back() -> bool:
            return all(
                now <= before.get(name, 0) + _MORE_DESCRIPTORS
                for name, now in self._open(world).items()
            )

        if before is not None:
            try:
                eventually(given_back, _GIVEN_BACK_S)
            except AssertionError:
                world.complain(f"{self}: descriptors before {before}, after {self._open(world)}")

    @staticmethod
    def _open(world: World) -> dict[str, int]:
        return {
            name: descriptors(one.pid) or 0
            for name in ("intake", "web")
            if (one := world.child(name)) is not None
        }


def _client_hello() -> bytes:
    """The first bytes of a TLS client."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    out = ssl.MemoryBIO()
    with contextlib.suppress(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), out).do_handshake()
    return out.read()


@dataclass(frozen=True)
class Descriptors(Step):
    """A process of the service has no descriptors left, as those who connect take all."""

    process: str = "web"
    count: int = 40

    def inject(self, world: World) -> None:
        found = world.child(self.process)
        held: list[socket.socket] = []
        world.kept[id(self)] = (found, held)
        if found is None:
            return
        most = (descriptors(found.pid) or 0) + _SPARE_DESCRIPTORS
        limits = resource.prlimit(found.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(found.pid, resource.RLIMIT_NOFILE, (most, limits[1]))
        world.kept[id(self)] = (found, held, limits, most)
        telemetry = int(world.service.endpoint.rpartition(":")[2])
        port = world.service.http if self.process == "web" else telemetry
        for _ in range(self.count):
            with contextlib.suppress(OSError):
                held.append(socket.create_connection(("127.0.0.1", port), _TIMEOUT_S))

    def lacking(self, world: World) -> str:
        found, held, *limited = world.kept[id(self)]
        if found is None or not limited:
            return f"no {self.process}"
        now = descriptors(found.pid) or 0
        world.say(f"Descriptors: {now} of {limited[1]}, {len(held)} connected")
        return "" if now >= limited[1] else f"{now} of {limited[1]} descriptors"

    def fix(self, world: World) -> None:
        found, held, *limited = world.kept.pop(id(self))
        for one in held:
            one.close()
        if limited and found.living:
            resource.prlimit(found.pid, resource.RLIMIT_NOFILE, limited[0])


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
        session = world.client(world.certificates)

        def say() -> None:
            kind, text = _twisted(draw)
            who = draw.choice(("blimp-1", "blimp-1", "blimp-9", "NOT-A-NAME", "x" * 40))
            session.zenoh.put(f"blimp/{who}/{kind}", text)

        return Background(say, 1.0 / self.rate_hz, Exception).at_end(session.close)


@dataclass(frozen=True)
class CommandFlood(Peer):
    """Many commands a second to the payload: asked for in vain, and IDR again and again."""

    rate_hz: float = 50.0

    def begin(self, world: World) -> Background:
        draw = world.draw()
        session = world.client(world.service.certificates)
        bodies = (
            messages.encode(messages.Command(time_ns=1)),
            messages.encode(messages.Command(time_ns=1, arguments={"kbps": 1e9})),
            b'{"schema": "blimp.command/1.0", "time_ns": 1, "arguments": {"kbps": NaN}}',
            b"",
            b"[]",
        )

        def ask() -> None:
            name = draw.choice(("idr", "bitrate", "exposure", "bogus", "reboot"))
            key = f"blimp/blimp-1/command/{name}"
            session.zenoh.get(key, lambda _: None, payload=draw.choice(bodies), timeout=0.5)

        return Background(ask, 1.0 / self.rate_hz, Exception).at_end(session.close)


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
