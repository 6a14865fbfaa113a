"""The socket that video comes in on."""

from __future__ import annotations

import contextlib
import socket

from pi_firmware.wire.errors import StreamError

BUFFER_BYTES = 4 << 20
"""What the receiver asks for: a second of video that a busy machine leaves waiting."""
_SO_RCVBUFFORCE = 33  # Linux, not in Python's socket module


def bind(host: str, port: int, poll_s: float) -> socket.socket:
    """A UDP socket with room for a burst, whose reads wait `poll_s`.

    Raises `StreamError` with one line.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        receiver = socket.socket(family, socket.SOCK_DGRAM)
    except OSError as error:
        raise StreamError(f"video on {host} port {port}: {error.strerror or error}") from None
    try:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        with contextlib.suppress(OSError):  # beyond the system's limit, where we may
            receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, BUFFER_BYTES)
        receiver.bind(address)
    except OSError as error:
        receiver.close()
        raise StreamError(f"video on {host} port {port}: {error.strerror or error}") from None
    receiver.settimeout(poll_s)
    return receiver
