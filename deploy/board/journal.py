"""What a service said last, for a person who has only a card reader."""

from __future__ import annotations

import re

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
