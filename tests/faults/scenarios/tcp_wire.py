"""A cable for TCP that can be cut or blocked, between a payload and its ground station."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Any

_POLL_S = 0.1


class TcpWire:
    """Relays connections from its own loopback `port` to another; a context manager.

    Cut, all connections are reset and none is taken. Blocked, they stay and nothing comes through:
    it waits, as on a radio out of reach. It is a cable again when all have repaired what they did.
    """

    def __init__(self, to_port: int) -> None:
        self._to = ("127.0.0.1", to_port)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._listening.settimeout(_POLL_S)
        self.port: int = self._listening.getsockname()[1]
        self._closing, self._open = threading.Event(), threading.Event()
        self._open.set()
        self._cutting: set[int] = set()
        self._blocking: set[int] = set()
        self._lock = threading.Lock()
        self._sockets: set[socket.socket] = set()
        self._threads = [threading.Thread(target=self._accept, name="wire", daemon=True)]

    def __enter__(self) -> TcpWire:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._open.set()
        self.cut()
        for thread in self._threads:
            thread.join()
        self._listening.close()

    def cut(self, who: object = None) -> None:
        """Resets all connections, and takes no other."""
        with self._lock:
            self._cutting.add(id(who))
            for one in self._sockets:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)

    def block(self, who: object = None) -> None:
        """Lets nothing through, in both directions."""
        with self._lock:
            self._blocking.add(id(who))
            self._open.clear()

    def fix(self, who: object = None) -> None:
        """Takes back what somebody did."""
        with self._lock:
            self._cutting.discard(id(who))
            self._blocking.discard(id(who))
            if not self._blocking:
                self._open.set()

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                near, _ = self._listening.accept()
            except OSError:
                continue
            with self._lock:
                far = None if self._cutting else self._dial()
                if far is None:
                    near.close()
                    continue
                for one in (near, far):
                    one.settimeout(None)
                self._sockets |= {near, far}
            for ends in ((near, far), (far, near)):
                thread = threading.Thread(target=self._carry, args=ends, name="wire", daemon=True)
                self._threads.append(thread)
                thread.start()

    def _dial(self) -> socket.socket | None:
        try:
            return socket.create_connection(self._to, timeout=1.0)
        except OSError:
            return None

    def _carry(self, source: socket.socket, to: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                while not self._open.wait(_POLL_S):
                    pass
                to.sendall(data)
        for one in (source, to):
            _shut(one)
        with self._lock:
            self._sockets -= {source, to}


def _shut(one: Any) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)
    one.close()
