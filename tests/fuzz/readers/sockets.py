"""`ground_station.doctor.sockets`: the kernel's table of sockets."""

from __future__ import annotations

import contextlib
import socket

from pieces import scratch

from ground_station.doctor import sockets

_PROC = scratch("sockets")
(_PROC / "net").mkdir()
_TABLE = (
    b"  sl  local_address rem_address   st\n   0: 0100007F:1F90 00000000:0000 0A 0:0 0:0 0 "
    b"1000 0 4242 1\n"
)


def fuzz(data: bytes) -> None:
    """A table that cannot be read raises what the doctor's round makes a finding of."""
    (_PROC / "net/udp").write_bytes(data)
    with contextlib.suppress(ValueError):
        sockets.holders(socket.SOCK_DGRAM, 8080, _PROC)


def seeds() -> list[bytes]:
    """A whole table, and a line of numbers that are none of it."""
    return [_TABLE, b"\n1 2 3 4 5 6 7 8 9 10 11\n"]
