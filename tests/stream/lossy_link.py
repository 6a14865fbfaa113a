"""A UDP relay that loses packets by a seed: the Wi-Fi of the tests."""

from __future__ import annotations

import random
import socket
import threading


class LossyLink:
    """Relays datagrams from its own `port` to another one on this machine, losing a share."""

    def __init__(self, to_port: int, loss: float, seed: int) -> None:
        self.passed = 0
        self.lost = 0
        self._to = ("127.0.0.1", to_port)
        self._loss = loss
        self._random = random.Random(seed)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.port = self._socket.getsockname()[1]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> LossyLink:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                datagram = self._socket.recv(65535)
            except TimeoutError:
                continue
            if self._random.random() < self._loss:
                self.lost += 1
            else:
                self.passed += 1
                self._socket.sendto(datagram, self._to)
