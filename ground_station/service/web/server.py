"""HTTP and WebSocket connections, bounded: uvicorn with limits that it lacks."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ground_station.errors import GroundStationError

CONNECTIONS = 256
_REQUEST_S = 10.0
_MESSAGE_BYTES = 8192
_BACKLOG = 128
_EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class _Http(H11Protocol):
    """Closes a connection whose next request does not come whole in time, and one too many."""

    _answered: Any = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > CONNECTIONS:
            transport.abort()
            return
        self.loop.call_later(_REQUEST_S, self._check)

    def _check(self) -> None:
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        if self.cycle is self._answered:  # none since the last look
            self.transport.abort()
            return
        self._answered = self.cycle if self.cycle.response_complete else None
        self.loop.call_later(_REQUEST_S, self._check)


class _WebSocket(WebSocketsSansIOProtocol):
    """Gives the application a way to end a connection that takes nothing: `scope["abort"]`."""

    async def run_asgi(self) -> None:
        scope: Any = self.scope
        scope["abort"] = self.transport.abort
        await super().run_asgi()


class Server(uvicorn.Server):
    """A server that leaves signals to its process."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def complain(log: Callable[[str, str], object], listening: socket.socket) -> Callable[..., None]:
    """A handler of a loop's exceptions: that no connection can be taken is one line to `log`.

    asyncio would tell it with a traceback for each place in the queue, again each second; and when
    the server ends within that second, each of these places is tried once more on a socket that is
    closed: 128 tracebacks, more than a pipe holds that is not read.
    """

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in _EXHAUSTED:
            log("connections", f"no connection is taken: {error.strerror}")
        elif not (isinstance(error, ValueError) and listening.fileno() < 0):
            loop.default_exception_handler(context)

    return handle


def server(app: ASGIApp) -> Server:
    """A server of an application, for a socket of `listen`."""
    return Server(
        uvicorn.Config(
            app,
            http=_Http,
            ws=_WebSocket,
            backlog=_BACKLOG,
            ws_max_size=_MESSAGE_BYTES,
            ws_ping_interval=20.0,
            ws_ping_timeout=20.0,
            ws_per_message_deflate=False,  # pictures are compressed already
            h11_max_incomplete_event_size=32 * 1024,
            timeout_keep_alive=10,
            timeout_graceful_shutdown=1,
            proxy_headers=False,  # nobody tells us another address than the connection's
            server_header=False,
            access_log=False,
            log_config=None,
            log_level="warning",
            lifespan="on",
        )
    )


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; raises `GroundStationError` with one line, as when the port is in use."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = found[0]
        return socket.create_server(address[:2], family=family, backlog=_BACKLOG)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
        raise GroundStationError(f"http {host}:{port}: {reason}") from None
