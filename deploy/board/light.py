"""Tells how the card is, by the light and STATUS.txt: `python3 -m deploy.board.light`.

It decides nothing and fixes nothing: what it tells of goes on without it.
"""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from deploy.board import provision, status
from deploy.board.card import Card
from deploy.board.disk import Disk
from deploy.board.releases import places
from deploy.board.releases.places import Places
from deploy.board.releases.service import UNIT, Seen, Service
from deploy.board.status import Fault, Status
from deploy.errors import DeployError

_SIOCGIFADDR = 0x8915  # linux/sockios.h
_MOST_SERVERS = 3  # resolv.conf(5)


class Link(NamedTuple):
    """An interface that can carry something; `address` is empty while it has none."""

    name: str
    radio: bool
    address: str


def ipv4(interface: str) -> str:
    """The interface's address; empty when it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            reply = fcntl.ioctl(any_socket, _SIOCGIFADDR, struct.pack("256s", interface.encode()))
        except OSError:
            return ""
    return socket.inet_ntoa(reply[20:24])


def links(root: Path, address: Callable[[str], str] = ipv4) -> list[Link]:
    """All interfaces but the loopback, by name; an address counts where there is a carrier."""
    try:
        folders = sorted((root / "sys/class/net").iterdir())
    except OSError:
        return []
    found = []
    for folder in folders:
        if folder.name == "lo" or not folder.is_dir():
            continue
        radio = (folder / "phy80211").exists() or (folder / "wireless").exists()
        found.append(Link(folder.name, radio, address(folder.name) if _carries(folder) else ""))
    return found


def name_servers(root: Path) -> list[str]:
    """Those that the networks have given, at most three."""
    try:
        lines = (root / "run/systemd/netif/state").read_text().splitlines()
    except (OSError, ValueError):
        return []
    words = next((line[4:].split() for line in lines if line.startswith("DNS=")), [])
    return [word for word in words if _is_address(word)][:_MOST_SERVERS]


def resolver_text(servers: list[str]) -> str:
    """resolv.conf; one question and no long wait, as a flight looks for one host at most."""
    return (
        "".join(f"nameserver {server}\n" for server in servers) + "options timeout:2 attempts:2\n"
    )


def _carries(folder: Path) -> bool:
    try:
        return (folder / "carrier").read_text().strip() == "1"
    except OSError:  # it is switched off
        return False


def _is_address(word: str) -> bool:
    try:
        ipaddress.ip_address(word)
    except ValueError:
        return False
    return True


_NAMES = ("ACT", "led0")  # of today's kernels and of older ones
_ON_S, _OFF_S, _PAUSE_S = 0.2, 0.3, 1.5


class StatusLed:
    """The light below `root`/sys; a board without one is dark and nothing fails."""

    def __init__(self, root: Path, sleep: Callable[[float], object] = time.sleep) -> None:
        self._sleep = sleep
        folders = [root / "sys/class/leds" / name for name in _NAMES]
        self._folder = next((folder for folder in folders if folder.is_dir()), None)
        self._trigger: str | None = None

    def heartbeat(self) -> None:
        """All is well: the kernel blinks twice a second; without its trigger the light is on."""
        if not self._set_trigger("heartbeat"):
            self.steady()

    def steady(self) -> None:
        """It is starting."""
        if self._set_trigger("none"):
            self._light(True)

    def blink(self, count: int) -> None:
        """`count` short blinks and the pause after them; it takes as long as that does."""
        self._set_trigger("none")
        for _ in range(count):
            self._light(True)
            self._sleep(_ON_S)
            self._light(False)
            self._sleep(_OFF_S)
        self._sleep(_PAUSE_S)

    def _set_trigger(self, name: str) -> bool:
        if self._trigger == name:
            return True
        if self._write("trigger", name):
            self._trigger = name
            return True
        return False

    def _light(self, on: bool) -> None:
        self._write("brightness", "255" if on else "0")

    def _write(self, file: str, text: str) -> bool:
        if self._folder is None:
            return False
        try:
            (self._folder / file).write_text(text)
        except OSError:
            return False
        return True


LOOK_S, CALM_S = 5.0, 20.0
"""So often it looks until a state has settled, and from then on: each look runs systemctl."""
PATIENCE_S = 90.0
"""A frame and an address may take so long to come."""
START_S = 240.0
"""The firmware's first start, which also lists GStreamer's plugins: systemd waits as long."""
SETTLED_S = 15.0
"""A state is written down when it has lasted so long; a flight's hiccup is not."""
MOST_WRITES = 5
"""A card wears: no more of them in one boot."""
_WIFI_UNIT = "blimp-wifi.service"


@dataclass(frozen=True)
class View:
    """The card at one moment."""

    outcome: dict[str, Any] = field(default_factory=dict)  # of provisioning; empty: it never ended
    data: str = ""  # what is wrong with the data partition
    firmware: Seen = Seen()  # noqa: RUF009
    links: tuple[Link, ...] = ()

    @property
    def address(self) -> str:
        """The first link with an address; the cable before the radio."""
        found = [link for link in self.links if link.address]
        return min(found, key=lambda link: link.radio).address if found else ""


class Judge:
    """What is wrong, with patience for what takes its time; `now` is in seconds, and never back."""

    def __init__(self, now_s: float) -> None:
        self._video_s = self._network_s = now_s

    def fault(self, view: View, now_s: float) -> tuple[Fault | None, bool]:
        """The worst fault, and whether the payload streams; neither while it is starting."""
        if view.firmware.active:
            self._video_s = now_s
        if view.address:
            self._network_s = now_s
        state = view.outcome.get("state")
        if view.data:
            return status.NO_DATA, False
        if state == provision.NONE and not view.outcome.get("reason"):
            return status.NO_PROVISIONING, False
        if state != provision.IN_FORCE:
            return status.REFUSED, view.firmware.active
        first = view.firmware.said == "activating" and not view.firmware.restarts
        if now_s - self._video_s >= (START_S if first else PATIENCE_S):
            return status.NO_VIDEO, False
        if now_s - self._network_s >= PATIENCE_S:
            return status.NO_NETWORK, view.firmware.active
        return None, view.firmware.active


class StatusWriter:
    """Writes STATUS.txt when a state has settled that is another than the one written last."""

    def __init__(self, card: Card, disk: Disk, now_s: float) -> None:
        self._card, self._disk = card, disk
        self._state: tuple[Fault | None, bool] | None = None
        self._since_s = now_s
        self.written = False  # what there is to tell of this state has been told
        self._failed = False
        self._writes = 0

    def report(
        self, fault: Fault | None, streams: bool, text: Callable[[], bytes], now_s: float
    ) -> None:
        """`text` makes the file; it is called when there is something to tell and no sooner."""
        if (fault, streams) != self._state:
            self._state, self._since_s, self.written = (fault, streams), now_s, False
        if self.written or now_s - self._since_s < SETTLED_S or self._writes >= MOST_WRITES:
            return
        if fault is None and not streams:
            return  # it is starting
        self.written = True
        try:
            self._writes += status.write(self._card, self._disk, text())
        except (DeployError, OSError) as error:
            if not self._failed:
                print(f"light: {status.FILE}: {error}", file=sys.stderr, flush=True)
            self._failed = True


def data_fault(root: Path) -> str:
    """What is wrong with the data partition; empty when it is mounted and can be written."""
    try:
        mounts = (root / "proc/mounts").read_text().splitlines()
    except OSError:
        return ""
    fields = [words for line in mounts if len(words := line.split()) > 3 and words[1] == "/data"]
    if not fields:
        return "it could not be mounted"
    if "ro" in fields[-1][3].split(","):
        return "it had an error while it was written, and is read-only since"
    return ""


def look(card: Card, service: Service) -> View:
    """The card as it is now."""
    return View(
        outcome=places.read(card.outcome) or {},
        data=data_fault(card.root),
        firmware=service.seen(),
        links=tuple(links(card.root)),
    )


def reason(fault: Fault | None, view: View) -> str:
    """What is known of a fault's cause, in one line."""
    if fault is status.NO_DATA:
        return view.data
    if fault is status.REFUSED:
        told = str(view.outcome.get("reason", ""))
        return told or "the program that reads this folder did not come to an end"
    if fault is status.NO_VIDEO:
        return status.of_firmware(status.said(UNIT)) or view.firmware.said
    if fault is status.NO_NETWORK and view.outcome.get("wifi"):
        if not any(link.radio for link in view.links):
            return "this board has no radio, or its driver did not start"
        return status.of_wifi(status.said(_WIFI_UNIT))
    return "no cable, or nobody there who gives addresses" if fault is status.NO_NETWORK else ""


def text_of(card: Card, fault: Fault | None, view: View) -> bytes:
    """STATUS.txt for this moment."""
    at = Places(card.root)
    board, running = places.read(at.board) or {}, places.read(at.running) or {}
    version, how = (str(running.get(name, "")) for name in ("version", "how"))
    if not version:
        version = str((places.read(at.factory / "release.json") or {}).get("version", ""))
    shown = [f"{link.name} {link.address}" for link in view.links if link.address]
    return status.render(
        Status(
            board=str(board.get("board", "")),
            image=str(board.get("image", "")),
            release=f"{version} ({how})" if how else version,
            payload_id=str(view.outcome.get("payload_id", "")),
            network=", ".join(shown),
            fault=fault,
            reason=reason(fault, view),
            warning=str(view.outcome.get("warning", "")),
        )
    )


def resolve(card: Card) -> None:
    """Keeps the name servers' file; a change is written beside and renamed."""
    text = resolver_text(name_servers(card.root))
    try:
        if card.resolver.exists() and card.resolver.read_text() == text:
            return
        part = card.resolver.with_name(card.resolver.name + ".part")
        part.write_text(text)
        part.replace(card.resolver)
    except OSError as error:
        print(f"light: {card.resolver}: {error.strerror}", file=sys.stderr, flush=True)


def main() -> int:
    """Runs until it is ended."""
    card, service = Card(), Service()
    now_s = time.monotonic()
    led, judge, status_writer = (
        StatusLed(card.root),
        Judge(now_s),
        StatusWriter(card, Disk(), now_s),
    )
    while True:
        begun_s = time.monotonic()
        view = look(card, service)
        resolve(card)
        fault, streams = judge.fault(view, begun_s)
        status_writer.report(fault, streams, partial(text_of, card, fault, view), begun_s)
        if fault is None:
            (led.heartbeat if streams else led.steady)()
        until_s = begun_s + (CALM_S if status_writer.written else LOOK_S)
        while fault is not None and time.monotonic() < until_s:
            led.blink(fault.blinks)
        time.sleep(max(0.0, until_s - time.monotonic()))


if __name__ == "__main__":
    sys.exit(main())
