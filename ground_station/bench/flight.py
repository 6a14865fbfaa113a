"""The payload's program as a process of its own that is watched from the ground while it runs."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_station.errors import GroundStationError
from ground_station.stream import rtp, udp
from ground_station.stream.counters import Counters
from pi_firmware.wire import sei
from pi_firmware.wire.telemetry import open_session

RATE_HZ = 30.0
_PAYLOAD_ID = "bench"
_LIMIT_S = 600.0
_COUNTERS = re.compile(r"frames: (\d+) captured, (\d+) gated, (\d+) sent")


class FlightError(GroundStationError):
    """The program could not be measured."""


@dataclass(frozen=True)
class Arrival:
    """An access unit's last packet here: the monotonic and the wall clock, and its own numbers."""

    monotonic_ns: int
    wall_ns: int
    info: sei.FrameInfo | None


class Ground:
    """A UDP port that takes the video and, with `telemetry`, an endpoint to connect to.

    A context manager; `arrivals` fill on a thread of its own.
    """

    def __init__(self, *, telemetry: bool = True) -> None:
        self.arrivals: list[Arrival] = []
        self._closing = threading.Event()
        self._socket = udp.bind("127.0.0.1", 0, 0.1)
        self._thread = threading.Thread(target=self._receive, name="bench-video", daemon=True)
        self._session: Any = None
        self._telemetry = telemetry

    def settings(self) -> list[str]:
        """What the payload has to be told to stream here, and nothing of this machine to touch."""
        endpoints = [f'"{name}"' for name in self._session.listening] if self._session else []
        return [
            f"payload_id={_PAYLOAD_ID}",
            "link.host=127.0.0.1",
            f"link.port={self._socket.getsockname()[1]}",
            f"telemetry.enabled={str(self._telemetry).lower()}",
            f"telemetry.connect=[{','.join(endpoints)}]",
            "battery.uri=fake:",
            "wifi.interface=",
            "supervision.frame_timeout_s=14",
        ]

    def __enter__(self) -> Ground:
        self._thread.start()
        if self._telemetry:
            self._session = open_session(listen=["tcp/127.0.0.1:0"])
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._socket.close()
        if self._session is not None:
            self._session.close()

    def _receive(self) -> None:
        counters = Counters()
        reorderer, depacketizer = rtp.Reorderer(counters), rtp.Depacketizer(counters)
        while True:
            try:
                datagram = self._socket.recv(65535)
            except TimeoutError:
                if self._closing.is_set():  # and nothing is left
                    return
                continue
            packet = rtp.parse(datagram, time.monotonic_ns())
            wall_ns = time.time_ns()
            for ordered, gap in reorderer.push(packet) if packet else ():
                for unit in depacketizer.push(ordered, gap):
                    info = sei.find(unit.data)
                    self.arrivals.append(Arrival(unit.arrival_ns, wall_ns, info))


@dataclass
class BenchFlight:
    """A running or ended program; `ready_ns` is when it had built everything, monotonic."""

    process: subprocess.Popen[str]
    begin_ns: int
    _log: Path
    ready_ns: int = 0
    said: str = ""
    errors: str = ""

    def counters(self) -> tuple[int, int, int]:
        """Frames captured, gated and sent, as the program printed them at its end."""
        match = _COUNTERS.search(self.said)
        if match is None:
            raise FlightError("the firmware ended without its frames' counters")
        return int(match[1]), int(match[2]), int(match[3])

    def end(self, *, by_signal: bool = False) -> None:
        """Waits for its end, which a signal may ask for; raises `FlightError` if it failed."""
        if by_signal:
            self.process.send_signal(signal.SIGTERM)
        try:
            status = self.process.wait(_LIMIT_S)
        except subprocess.TimeoutExpired:
            raise FlightError(f"the firmware did not end within {_LIMIT_S:g} s") from None
        self._reader.join()
        self.errors = self._log.read_text(errors="replace")
        if status:
            line = (self.errors.strip().splitlines() or ["nothing"])[-1]
            raise FlightError(f"the firmware ended with status {status}: {line}")

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.ready_ns = self.ready_ns or time.monotonic_ns()
            self.said += line


@contextlib.contextmanager
def fly(
    ground: Ground, settings: Sequence[str], *, python: Sequence[str] = ()
) -> Iterator[BenchFlight]:
    """Starts the program with `KEY=VALUE` settings and kills it at the block's end if need be.

    `python` are options of the interpreter.
    """
    sets = [word for setting in (*ground.settings(), *settings) for word in ("--set", setting)]
    with tempfile.TemporaryDirectory() as folder:
        errors = Path(folder) / "errors.txt"
        with errors.open("w") as log:
            begin_ns = time.monotonic_ns()
            process = subprocess.Popen(
                [sys.executable, *python, "-m", "pi_firmware", *sets],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                errors="replace",
                # Hashes are drawn at each start otherwise, and with them the cost of dictionaries.
                env={**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": folder},
            )
        try:
            yield BenchFlight(process, begin_ns, errors)
        finally:
            process.kill()
            process.wait()


def picture(seconds: float) -> str:
    """The setting of a test picture that ends after `seconds` at `RATE_HZ`."""
    return f"camera.uri=test:?pattern=zone-plate&duration_s={seconds:.6f}"
