"""STATUS.txt on the boot partition: how the card is, for whoever puts it into a laptop.

What can be wrong is one table, which the light tells by its blinks.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from deploy.board.card import Card, writable
from deploy.board.disk import Disk, read_bounded
from deploy.errors import DeployError
from deploy.run import run

_LIMIT_S = 10.0
_LINES = 60
_MOST = 300
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]+")
# What wpa_supplicant says, most telling first, and what it means.
_WIFI = (
    ("WRONG_KEY", "the network refuses the password"),
    ("4-Way Handshake failed", "the network refuses the password"),
    ("CTRL-EVENT-ASSOC-REJECT", "the network refuses the payload"),
    ("CTRL-EVENT-AUTH-REJECT", "the network refuses the payload"),
    ("CTRL-EVENT-NETWORK-NOT-FOUND", "the network is not in reach, or has another name"),
    ("CTRL-EVENT-CONNECTED", "connected, and no address was given by the network"),
)


def one_line(text: str, most: int = _MOST) -> str:
    """A text of somebody else's as one printable line."""
    line = " ".join(_CONTROL.sub(" ", text).split())
    return line if len(line) <= most else line[: most - 1] + "…"


def said(unit: str) -> list[str]:
    """A unit's last lines in this boot, oldest first; none when they cannot be had."""
    words = ["journalctl", "--boot", "--output=cat", "--no-pager", "-n", str(_LINES), "-u", unit]
    try:
        return run(words, timeout_s=_LIMIT_S).decode(errors="replace").splitlines()
    except DeployError:
        return []


def of_firmware(lines: list[str]) -> str:
    """The firmware's last complaint; empty when it had none."""
    others = [line for line in lines if not line.startswith("start: ")]
    complaints = [line for line in others if line.startswith("pi_firmware: ")]
    last = (complaints or others or [""])[-1]
    return one_line(last.removeprefix("pi_firmware: "))


def of_wifi(lines: list[str]) -> str:
    """Why there is no Wi-Fi, as far as wpa_supplicant tells; the last sign counts."""
    for line in reversed(lines):
        for sign, meaning in _WIFI:
            if sign in line:
                return meaning
    return one_line(lines[-1]) if lines else ""


class Fault(NamedTuple):
    """`blinks` short ones and a pause; `fix` is what a person can do about it."""

    blinks: int
    what: str
    fix: str


NO_PROVISIONING = Fault(
    2,
    "the card has not been told which payload it is",
    "Put blimp.toml and the folder certificates into this folder (the ground station's `make flash`"
    " does so), and start the payload again.",
)
REFUSED = Fault(
    3,
    "something in this folder is refused; what was in force before still is",
    "Fix what the reason names, here on the boot partition, and start the payload again.",
)
NO_VIDEO = Fault(
    4,
    "the firmware sends no video",
    "Look at the camera's cable first. Settings of your own are in payload.toml in this folder:"
    " without that file the board's own are used.",
)
NO_NETWORK = Fault(
    5,
    "no network",
    "Check name, password, security and country of [wifi] in blimp.toml, and that the network is in"
    " reach: 2.4 GHz, as the Zero has no other. A new password is written there as it is; the card"
    " takes it out again.",
)
NO_DATA = Fault(
    6,
    "the data partition is broken or full",
    "Save what you need of it (it is the card's third partition, ext4), then write the card again."
    " A card that this happens to again is worn: take another one.",
)
ALL = (NO_PROVISIONING, REFUSED, NO_VIDEO, NO_NETWORK, NO_DATA)


FILE = "STATUS.txt"
_MOST_BYTES = 64 * 1024


@dataclass(frozen=True)
class Status:
    """All that the file tells. There is no time in it: a board without a clock has none, and a
    text that stays the same is not written again."""

    board: str = ""
    image: str = ""
    release: str = ""
    payload_id: str = ""
    network: str = ""
    fault: Fault | None = None
    reason: str = ""
    warning: str = ""


def render(status: Status) -> bytes:
    """The file: UTF-8, with the line ends of Windows, whose editor knows no others."""
    fault = status.fault
    blinks = f" ({fault.blinks} blinks)" if fault else ""
    lines = [
        "Blimp payload: how this card was when it last wrote this file.",
        "",
        f"State:    {'FAULT: ' + fault.what + blinks if fault else 'streaming'}",
    ]
    if fault and status.reason:
        lines.append(f"Reason:   {one_line(status.reason)}")
    if fault:
        lines.append(f"To fix:  {fault.fix}")
    if status.warning:
        lines.append(f"Warning:  {one_line(status.warning)}")
    lines += [
        "",
        f"Payload:  {one_line(status.payload_id) or 'none yet'}",
        f"Network:  {one_line(status.network) or 'none'}",
        f"Firmware: {one_line(status.release) or 'unknown'}",
        f"Image:    {one_line(status.image) or 'unknown'}, for the board {one_line(status.board)}",
        "",
        "The green light: steady is starting, a heartbeat is streaming; so many short blinks and a",
        "pause mean:",
        *(f"  {fault.blinks}  {fault.what}" for fault in ALL),
        "",
        "To change name, network or keys: edit blimp.toml in this folder, start the payload again.",
    ]
    return "".join(f"{line}\r\n" for line in lines).encode()


def write(card: Card, disk: Disk, text: bytes) -> bool:
    """Writes the file unless it says the same already; whether the card was written to.

    Raises `DeployError` and `OSError` when it cannot be.
    """
    path = card.boot / FILE
    if not card.boot.is_dir():
        raise DeployError(f"{card.boot}: not there")
    if read_bounded(path, _MOST_BYTES) == text:
        return False
    with writable(card):
        disk.write(path, text)
    return True
