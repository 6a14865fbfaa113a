"""Payload and ground station as hosts at one access point, and what befalls a radio's network.

`unshare -rn python roaming_hosts.py FOLDER` is the ground station's host: the whole service and the
firmware fly as they are installed, by TLS and SRTP, and find each other. Prints one JSON object of
each case's `Result`.
"""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS / room) for room in ("faults", "hil", "service", "stream")]

from links.namespace import Holder, NamespaceError, run  # noqa: E402
from payload_process import PayloadProcess  # noqa: E402
from scenarios.burden import Burden  # noqa: E402
from scenarios.heard import Heard  # noqa: E402
from scenarios.judge import TRACKING  # noqa: E402
from scenarios.world import HOPELESS, NAME  # noqa: E402
from standing import ATRIUM, Service  # noqa: E402

GROUND, PAYLOAD, TELEMETRY_PORT = "10.9.0.1", "10.9.0.2", 7447
RATE_HZ = 10.0
CARD = TESTS.parent / "deploy/board/root/etc/sysctl.d/10-blimp.conf"
_BETWEEN = ("air", "wire")
_TWIN = """
import socket, struct, sys, time
own, address = bytes.fromhex(sys.argv[2].replace(":", "")), socket.inet_aton(sys.argv[3])
arp = struct.pack("!HHBBH6s4s6s4s", 1, 0x0800, 6, 4, 2, own, address, b"\\xff" * 6, address)
with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as out:
    out.bind((sys.argv[1], 0))
    while True:
        out.send(b"\\xff" * 6 + own + b"\\x08\\x06" + arp)
        time.sleep(0.05)
"""
"""Says again and again that an address is its own (RFC 826): gratuitous answers."""


@dataclass
class Result:
    """Of one case: `lacking` is what of the fault could not be seen, `lacks` what did not return.

    `seen_s` is when the first frame came that was TRACKING, and `back_s` when all was, None: not
    within the case's bound, times the `factor` by which the machine was burdened. `starts` is how
    often the firmware had been started by then.
    """

    lacking: str = ""
    seen_s: float | None = None
    back_s: float | None = None
    factor: float = 1.0
    starts: int = 1
    lacks: str = ""


class Hosts:
    """The hosts at the access point, a bridge of its own: a context manager."""

    def __enter__(self) -> Hosts:
        with contextlib.ExitStack() as stack:
            self.air, self.payload, self.other = (stack.enter_context(Holder()) for _ in range(3))
            run("ip", "link", "set", "lo", "up")
            # Two bridges: what is too large for the way between them vanishes unseen by any host.
            for bridge in ("wire", "air"):
                self.air.run("ip", "link", "add", bridge, "type", "bridge")
                self.air.run("ip", "link", "set", bridge, "up")
            self.air.run("ip", "link", "add", "to-air", "type", "veth", "peer", "name", "to-wire")
            self.air.run("ip", "link", "set", "to-air", "master", "wire", "up")
            self.air.run("ip", "link", "set", "to-wire", "master", "air", "up")
            for name, address, bridge in (
                ("ground", GROUND, "wire"), ("payload", PAYLOAD, "air"), ("other", "", "air"),
            ):  # fmt: skip
                host = getattr(self, name, None)
                run("ip", "link", "add", f"{name}0", "type", "veth", "peer", "name", f"to-{name}")
                run("ip", "link", "set", f"to-{name}", "netns", str(self.air.pid))
                self.air.run("ip", "link", "set", f"to-{name}", "master", bridge, "up")
                if host is not None:
                    run("ip", "link", "set", f"{name}0", "netns", str(host.pid))
                inside = host.run if host is not None else run
                # An access point gets packets one by one: none leaves joined to a large one.
                inside("ip", "link", "set", f"{name}0", "up", "gso_max_segs", "1")
                if address:
                    inside("ip", "addr", "add", f"{address}/24", "dev", f"{name}0")
            card = CARD.read_text().replace("wlan0", "payload0")
            for key, value in re.findall(r"(?m)^-?(net\S+) = (\S+)$", card):
                self.payload.run("sh", "-c", f"echo {value} > /proc/sys/{key.replace('.', '/')}")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def ports(self, *words: str, names: tuple[str, str] = ("ground", "payload")) -> None:
        """Sets something of the access point's side of both, or of the way between its bridges."""
        for name in names:
            self.air.run("ip", "link", "set", f"to-{name}", *words)

    def neighbour(self, inside: Callable[..., str], address: str) -> str:
        """The hardware address that a host holds an address for; "" for none."""
        found = re.search(r"lladdr (\S+)", inside("ip", "neigh", "show", address))
        return found[1] if found else ""


class Flight:
    """The service, and the firmware as an init system keeps it, at the access point."""

    def __init__(self, hosts: Hosts, folder: Path) -> None:
        self.hosts, self.heard = hosts, Heard()
        self._folder, self.runs = folder, list[tuple[PayloadProcess, float]]()
        self.connect: list[str] = []
        self.service = Service(
            folder,
            f"video.host={GROUND}",
            f'telemetry.listen=["tls/{GROUND}:{TELEMETRY_PORT}"]',
            "telemetry.discoverable=ground0",
        )

    def __enter__(self) -> Flight:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.service)
            self.heard.listen(stack.enter_context(self.service.bus()), 0)
            stack.callback(lambda: self.runs and self.runs[-1][0].__exit__())
            self.fly()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def fly(self) -> None:
        """Starts the firmware, which is told of no address but those of `connect`."""
        if self.runs:
            self.runs[-1][0].__exit__()
        process = PayloadProcess(
            self._folder / f"payload-{len(self.runs)}",
            f"payload_id={NAME}",
            f"camera.uri=replay:{ATRIUM / 'flight.mcap'}?loop=1&rate_hz={RATE_HZ:g}",
            f"camera.rate_hz={RATE_HZ:g}",
            "link.host=auto",
            "wifi.interface=",
            f"telemetry.connect={json.dumps(self.connect)}",
            "telemetry.discover=payload0",
            f"telemetry.certificates={self.service.authority.of(f'payload.{NAME}')}",
            prefix=self.hosts.payload.prefix,
        )
        self.runs.append((process, time.monotonic()))

    def rest(self, seconds: float) -> None:
        """Lets time pass; what systemd would start again is started again."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            process, _ = self.runs[-1]
            if not process.running:
                ended = process.end(None)
                assert ended.status == HOPELESS, ended
                self.fly()
            time.sleep(0.05)

    def tracked(self, since_s: float) -> bool:
        """Whether a frame has come since then, and was localized."""
        told = [one for one in self.heard.estimates()[-10:] if one.at_s > since_s]
        shown = self.heard.frames(NAME)[-1:]
        return any(one.note.state == TRACKING for one in told) and shown[0].at_s > since_s

    def told(self, since_s: float) -> str:
        """What of telemetry has not come since then, in words."""
        note = self.heard.payload(NAME, since_s)
        health = note.health if note is not None and note.alive else None
        if health is None or self.runs[-1][1] + health.uptime_s < since_s:
            return "no telemetry"
        return "the payload hears nothing" if health.round_trip_s is None else ""

    def back(self, bound_s: float) -> Result:
        """When telemetry both ways and TRACKING are back, of what comes from now on."""
        burden, since_s, looked_s = Burden(), time.monotonic(), 0.0
        pids = [one.pid for one in self.service.processes().values()]
        result = Result()
        while (now_s := time.monotonic()) < since_s + bound_s * burden.factor:
            if result.seen_s is None and self.tracked(since_s):
                result.seen_s = round(now_s - since_s, 1)
            result.lacks = self.told(since_s) or ("" if result.seen_s else "no TRACKING")
            if now_s - looked_s > 0.5:
                looked_s = now_s
                burden.look([*pids, self.runs[-1][0].pid])
                result.factor = round(burden.factor, 1)
            if not result.lacks:
                result.back_s = round(now_s - since_s, 1)
                break
            self.rest(0.05)
        return result

    def silent(self, for_s: float) -> str:
        """Lets time pass, in whose second half no video may come; how much did, in words."""
        self.rest(for_s / 2)
        before = len(self.heard.frames(NAME))
        self.rest(for_s / 2)
        more = len(self.heard.frames(NAME)) - before
        return f"{more} frames came" if more else ""


def address_changes(flight: Flight) -> str:
    """The payload gets another address, as from another DHCP server."""
    inside = flight.hosts.payload.run
    inside("ip", "addr", "flush", "dev", "payload0")
    lacking = flight.silent(5.0)
    inside("ip", "addr", "add", "10.9.0.77/24", "dev", "payload0")
    return lacking


def restarts(flight: Flight) -> str:
    """The access point restarts: no link for 15 s, and both hosts have forgotten each other."""
    hosts = flight.hosts
    hosts.ports("down")
    lacking = flight.silent(15.0)
    for inside, name in ((run, "ground0"), (hosts.payload.run, "payload0")):
        inside("ip", "neigh", "flush", "dev", name)
    hosts.ports("up")
    return lacking


def deauthenticated(flight: Flight) -> str:
    """The payload's link goes for half a second, ten times within fifteen."""
    air, payload = flight.hosts.air.run, flight.hosts.payload.run
    gone = 0
    for _ in range(10):
        air("ip", "link", "set", "to-payload", "down")
        gone += "NO-CARRIER" in payload("ip", "-br", "link", "show", "payload0")
        flight.rest(0.5)
        air("ip", "link", "set", "to-payload", "up")
        flight.rest(1.0)
    return "" if gone == 10 else f"the link was gone {gone} times"


def narrow(flight: Flight) -> str:
    """Packets of more than 1,280 bytes vanish at the access point, without a word."""
    hosts = flight.hosts
    hosts.ports("mtu", "1280", names=_BETWEEN)
    with contextlib.suppress(NamespaceError):
        hosts.payload.run("ping", "-c1", "-W1", "-Mdo", "-s1300", GROUND)
        return "a packet of 1,300 bytes came through"
    flight.fly()  # so that TLS begins anew, too
    return ""


def wide(flight: Flight) -> str:
    """The access point as it was."""
    flight.hosts.ports("mtu", "1500", names=_BETWEEN)
    return ""


def no_multicast(flight: Flight) -> str:
    """Multicast is not handed on: a payload that starts then finds nobody, if told of nobody."""
    hosts = flight.hosts
    hosts.ports("type", "bridge_slave", "mcast_flood", "off")
    flight.fly()
    flight.rest(2.0)  # what was said before its start is none of this one's
    found = flight.back(10.0)
    flight.connect = [f"tls/{GROUND}:{TELEMETRY_PORT}"]
    flight.fly()
    return "it was found" if found.back_s is not None else ""


def _twin(flight: Flight, address: str, inside: Callable[..., str]) -> str:
    """Another station has an address for 10 s; what is wrong if a host never sent to it, in words.

    The host, which commands run `inside`, may find out at times, and be told the wrong one again.
    """
    other, held = flight.hosts.other, set[str]()
    other.run("ip", "addr", "add", f"{address}/24", "dev", "other0")
    own = other.run("ip", "-br", "link", "show", "other0").split()[2]
    command = [*other.prefix, sys.executable, "-c", _TWIN, "other0", own, address]
    with subprocess.Popen(command) as saying:
        try:
            for _ in range(20):
                flight.rest(0.5)
                held.add(flight.hosts.neighbour(inside, address))
        finally:
            saying.kill()
    other.run("ip", "addr", "flush", "dev", "other0")
    return "" if own in held else f"packets went to {', '.join(sorted(held))}"


def payload_twin(flight: Flight) -> str:
    """Another station has the payload's address for 10 s."""
    return _twin(flight, PAYLOAD, run)


def ground_twin(flight: Flight) -> str:
    """Another station has the ground's address for 10 s."""
    return _twin(flight, GROUND, flight.hosts.payload.run)


CASES: dict[str, tuple[Callable[[Flight], str], float]] = {
    case.__name__: (case, bound_s)
    for case, bound_s in (
        (restarts, 20.0), (deauthenticated, 15.0), (payload_twin, 20.0), (ground_twin, 20.0),
        (address_changes, 15.0), (narrow, 15.0), (wide, 10.0), (no_multicast, 20.0),
    )
}  # fmt: skip
"""Each with the seconds until all is back, on a machine without other work."""
STARTED_S = 40.0


def main(folder: Path, *names: str) -> dict[str, object]:
    """Flies the cases one after another, all without any names; what came of each."""
    said: dict[str, object] = {}
    with Hosts() as hosts, Flight(hosts, folder) as flight:
        said["start"] = asdict(flight.back(STARTED_S))
        for name in names or CASES:
            befall, bound_s = CASES[name]
            lacking = befall(flight)
            result = flight.back(bound_s)
            result.lacking, result.starts = lacking, len(flight.runs)
            said[name] = asdict(result)
            print(name, result, file=sys.stderr, flush=True)
            flight.rest(2.0)
        flight.runs[-1][0].end().assert_in_order()
    return said


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), *sys.argv[2:])))
