"""The payload's program with somebody at the end of its video who keeps every datagram."""

from __future__ import annotations

import contextlib
import gc
import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from unittest import mock

from ground_station.stream import rtp
from ground_station.stream.counters import Counters
from pi_firmware import __main__ as program
from pi_firmware.sources.schemes import test as test_cameras
from pi_firmware.wire import annexb, sei

LIMIT_S = 60.0
"""How long a condition is waited for on a busy machine before a test fails."""
_ATTEMPTS = 3


@dataclass(frozen=True)
class Frame:
    """One access unit as it left the payload, and the numbers in it."""

    info: sei.FrameInfo
    data: bytes

    @property
    def idr(self) -> bool:
        return annexb.is_idr(self.data)


class Tap:
    """Takes datagrams at a free port of `host`; a context manager."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self.datagrams: list[bytes] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind((host, 0))
        self._socket.settimeout(0.1)
        self.host, self.port = self._socket.getsockname()
        self._sender: tuple[str, int] | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Tap:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Takes what is still on its way, then closes."""
        self._closing.set()
        self._thread.join()
        self._socket.close()

    def packets(self, *, again: bool = False) -> list[rtp.Packet]:
        """Those of the datagrams that are RTP of our video, whatever they carry.

        `again`: those that were sent again, and no others.
        """
        parsed = (rtp.parse(datagram, 0) for datagram in list(self.datagrams))
        return [packet for packet in parsed if packet is not None and packet.again == again]

    def answer(self, datagram: bytes) -> None:
        """Sends this to where the newest datagram came from."""
        assert self._sender is not None
        self._socket.sendto(datagram, self._sender)

    def frames(self) -> list[Frame]:
        """The frames in plain RTP; none in what is encrypted."""
        depacketizer = rtp.Depacketizer(Counters())
        units = [unit for packet in self.packets() for unit in depacketizer.push(packet, False)]
        found = ((sei.find(unit.data), unit.data) for unit in units)
        return [Frame(info, data) for info, data in found if info is not None]

    def _run(self) -> None:
        while True:
            try:
                datagram, self._sender = self._socket.recvfrom(65535)
            except TimeoutError:
                if self._closing.is_set():
                    return
            else:
                self.datagrams.append(datagram)


def words(settings: Mapping[str, object]) -> list[str]:
    """`--set` for each of the settings."""
    given = []
    for key, value in settings.items():
        text = value if isinstance(value, str) else json.dumps(value)
        given += ["--set", f"{key}={text}"]
    return given


def start(settings: Mapping[str, object]) -> subprocess.Popen[str]:
    """The program as a process."""
    command = [sys.executable, "-m", "pi_firmware", *words(settings)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(*arguments: str) -> tuple[int, str, str]:
    """The program's `main` in this process, ended after a while: its status, and what it wrote."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    overdue = threading.Timer(LIMIT_S, os.kill, (os.getpid(), signal.SIGTERM))
    test_cameras._first_opened_s.clear()  # their faults count from then, in each program
    out, err = io.StringIO(), io.StringIO()
    try:
        with (
            mock.patch.object(sys, "argv", ["pi_firmware", *arguments]),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            overdue.start()
            status = program.main()
    finally:
        overdue.cancel()
        gc.unfreeze()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return status, out.getvalue(), err.getvalue()


@dataclass(frozen=True)
class Flown:
    """A program that has ended: its status, what it wrote, and what left it."""

    status: int
    out: str
    err: str
    tap: Tap

    @property
    def frames(self) -> list[Frame]:
        return self.tap.frames()

    @property
    def sequences(self) -> list[int]:
        return [frame.info.sequence for frame in self.frames]

    @property
    def idrs(self) -> list[int]:
        return [frame.info.sequence for frame in self.frames if frame.idr]


def fly(settings: Mapping[str, object]) -> Flown:
    """Flies until the program ends by itself; without telemetry unless the settings say so.

    A recording that is stepped fills the link's queue when the machine stops the link for a tenth
    of a second, and the payload discards frames, as it must: then it is flown again.
    """
    for _ in range(_ATTEMPTS):
        flown = _flown(settings)
        if " discarded" not in flown.out:
            break
    return flown


def _flown(settings: Mapping[str, object]) -> Flown:
    with Tap() as tap:
        given = {"link.port": tap.port, "telemetry.enabled": False, **settings}
        status, out, err = run(*words(given))
    return Flown(status, out, err, tap)
