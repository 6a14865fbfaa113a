"""Tells how the card is, by the light and STATUS.txt: `python3 -m deploy.board.light`.

It decides nothing and fixes nothing: what it tells of goes on without it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from deploy.board import faults, journal, network, provision, status
from deploy.board.card import Card
from deploy.board.disk import Disk
from deploy.board.faults import Fault
from deploy.board.network import Link
from deploy.board.releases import places
from deploy.board.releases.places import Places
from deploy.board.releases.service import UNIT, Seen, Service
from deploy.board.status import Status
from deploy.board.status_led import StatusLed
from deploy.errors import DeployError

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
            return faults.NO_DATA, False
        if state == provision.NONE and not view.outcome.get("reason"):
            return faults.NO_PROVISIONING, False
        if state != provision.IN_FORCE:
            return faults.REFUSED, view.firmware.active
        first = view.firmware.said == "activating" and not view.firmware.restarts
        if now_s - self._video_s >= (START_S if first else PATIENCE_S):
            return faults.NO_VIDEO, False
        if now_s - self._network_s >= PATIENCE_S:
            return faults.NO_NETWORK, view.firmware.active
        return None, view.firmware.active


class Teller:
    """Writes STATUS.txt when a state has settled that is another than the one written last."""

    def __init__(self, card: Card, disk: Disk, now_s: float) -> None:
        self._card, self._disk = card, disk
        self._state: tuple[Fault | None, bool] | None = None
        self._since_s = now_s
        self.told = False  # what there is to tell of this state has been told
        self._failed = False
        self._writes = 0

    def tell(
        self, fault: Fault | None, streams: bool, text: Callable[[], bytes], now_s: float
    ) -> None:
        """`text` makes the file; it is called when there is something to tell and no sooner."""
        if (fault, streams) != self._state:
            self._state, self._since_s, self.told = (fault, streams), now_s, False
        if self.told or now_s - self._since_s < SETTLED_S or self._writes >= MOST_WRITES:
            return
        if fault is None and not streams:
            return  # it is starting
        self.told = True
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
        links=tuple(network.links(card.root)),
    )


def reason(fault: Fault | None, view: View) -> str:
    """What is known of a fault's cause, in one line."""
    if fault is faults.NO_DATA:
        return view.data
    if fault is faults.REFUSED:
        told = str(view.outcome.get("reason", ""))
        return told or "the program that reads this folder did not come to an end"
    if fault is faults.NO_VIDEO:
        return journal.of_firmware(journal.said(UNIT)) or view.firmware.said
    if fault is faults.NO_NETWORK and view.outcome.get("wifi"):
        if not any(link.radio for link in view.links):
            return "this board has no radio, or its driver did not start"
        return journal.of_wifi(journal.said(_WIFI_UNIT))
    return "no cable, or nobody there who gives addresses" if fault is faults.NO_NETWORK else ""


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
    text = network.resolver_text(network.name_servers(card.root))
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
    led, judge, teller = StatusLed(card.root), Judge(now_s), Teller(card, Disk(), now_s)
    while True:
        begun_s = time.monotonic()
        view = look(card, service)
        resolve(card)
        fault, streams = judge.fault(view, begun_s)
        teller.tell(fault, streams, partial(text_of, card, fault, view), begun_s)
        if fault is None:
            (led.heartbeat if streams else led.steady)()
        until_s = begun_s + (CALM_S if teller.told else LOOK_S)
        while fault is not None and time.monotonic() < until_s:
            led.blink(fault.blinks)
        time.sleep(max(0.0, until_s - time.monotonic()))


if __name__ == "__main__":
    sys.exit(main())
