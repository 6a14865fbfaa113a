"""The board's network as the kernel and systemd-networkd tell it, and the name servers' file."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

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
