"""The socket that video comes in on."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

from pi_firmware.wire.errors import StreamError, os_errors_as

BUFFER_BYTES = 4 << 20
"""What the receiver asks for: a second of video that a busy machine leaves waiting."""
_SO_RCVBUFFORCE = 33  # Linux, not in Python's socket module
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_LONGEST_WAIT_NS = 5_000_000_000

Address = tuple[str, int] | tuple[str, int, int, int]
"""Of IPv4 or IPv6, as a socket says it."""


def bind(host: str, port: int, poll_s: float) -> socket.socket:
    """A UDP socket with room for a burst, whose reads wait `poll_s`.

    Raises `StreamError` with one line.
    """
    with os_errors_as(f"video on {host} port {port}", StreamError):
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        receiver = socket.socket(family, socket.SOCK_DGRAM)
        try:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            with contextlib.suppress(OSError):  # beyond the system's limit, where we may
                receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, BUFFER_BYTES)
            with contextlib.suppress(OSError):
                receiver.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            receiver.bind(address)
        except OSError:
            receiver.close()
            raise
    receiver.settimeout(poll_s)
    return receiver


def read(receiver: socket.socket) -> tuple[bytes, int, Address]:
    """The next datagram, how long the machine has had it, ns, 0 where it does not tell, and whose.

    Raises `OSError` like the socket, `TimeoutError` when none comes.
    """
    datagram, said, _, address = receiver.recvmsg(65535, socket.CMSG_SPACE(_TIMESPEC.size))
    for level, kind, data in said:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS, _TIMESPEC.size):
            seconds, ns = _TIMESPEC.unpack(data)
            waited_ns = time.time_ns() - (seconds * 10**9 + ns)
            # The stamp is the wall clock's, which may have been set in between.
            is_sound = 0 <= waited_ns < _LONGEST_WAIT_NS
            return datagram, waited_ns if is_sound else 0, address
    return datagram, 0, address
