"""How a payload finds its ground station: Zenoh's scouting, on one interface that is named.

The payload asks a multicast group (224.0.0.224, UDP port 7446) who is there, a ground station
answers with the endpoints it listens on. That says nothing secret and proves nothing: whom a
payload then speaks to is for the certificates to decide.
"""

from __future__ import annotations

import fcntl
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

from pi_firmware.wire.errors import TelemetryError

LOOPBACK_INTERFACE = "lo"
INTERFACE_WAIT_S = 10.0
"""A radio that was just switched on gets its address within this."""
_POLL_S = 0.2
_SIOCGIFADDR = 0x8915  # Linux, not in Python's modules


def interface_address(interface: str) -> str | None:
    """The interface's IPv4 address; None while it has none, or is not there."""
    name = interface.encode(errors="replace")
    if not 0 < len(name) < 16:  # Linux has no longer names
        return None
    request = struct.pack("256s", name)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        try:
            reply = fcntl.ioctl(any_socket.fileno(), _SIOCGIFADDR, request)
        except OSError:
            return None
    return socket.inet_ntoa(reply[20:24])


def check(scout: str, discoverable: str, listen: Sequence[str], *, certified: bool) -> str:
    """The interface to look or answer on, or none; raises `TelemetryError` for one not allowed."""
    interface = scout or discoverable
    if scout and discoverable and scout != discoverable:
        raise TelemetryError(f"discovery on {scout!r} and {discoverable!r}: only one is possible")
    if interface and not certified and interface != LOOPBACK_INTERFACE:
        raise TelemetryError(
            f"discovery on {interface!r}: without certificates only"
            f" {LOOPBACK_INTERFACE!r} is allowed"
        )
    if discoverable and not listen:
        raise TelemetryError(f"discovery on {interface!r}: an endpoint to listen on is needed")
    return interface


def await_address(interface: str) -> str:
    """The interface's address; empty when it gets none in time.

    Raises `TelemetryError` when there is no such interface by then.
    """
    until_s = time.monotonic() + INTERFACE_WAIT_S
    while (address := interface_address(interface)) is None:
        if time.monotonic() > until_s:
            known = [name for _, name in socket.if_nameindex()]
            if interface not in known:
                raise TelemetryError(
                    f"discovery on {interface!r}: no such interface"
                    f" (there are: {', '.join(known) or 'none'})"
                )
            return ""
        time.sleep(_POLL_S)
    return address


def settings(interface: str, *, look: bool, answer: bool) -> dict[str, Any]:
    """Zenoh's settings to look for others on an interface, and to answer there."""
    values = {
        "enabled": True,
        "interface": interface,
        "ttl": 1,  # this network and no further
        "listen": answer,
        "autoconnect": {"peer": ["peer"] if look else []},
    }
    return {f"scouting/multicast/{name}": value for name, value in values.items()}
