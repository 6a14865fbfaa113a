"""The payload's figures: start, latency, memory and processor time a frame of the real program.

It runs as a process of its own and is watched from the ground.
"""

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
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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


_SEND_ALL = "gate.enabled=false"  # it measures all the same; the test picture moves too slowly
_START_LIMIT_S = 60.0
_LIMIT_MB = 120.0
_IMPORT = re.compile(r"import time: +(\d+) \| +\d+ \| +(\S+)")
_STATUS = re.compile(r"(VmHWM|VmRSS):\s+(\d+) kB")
_MAPPING = re.compile(r"[0-9a-f]+-[0-9a-f]+ \S+ \S+ \S+ \d+ *(.*)")


def start(repetitions: int) -> dict[str, Any]:
    """Times from exec on, medians: Python alone, all built, first access unit at the port.

    Then the modules whose own import takes longest, by Python's `-X importtime` in one more run,
    which makes imports somewhat slower.
    """
    python_s: list[float] = []
    ready_s: list[float] = []
    first_s: list[float] = []
    with Ground(telemetry=False) as ground:
        for _ in range(repetitions):
            begin_ns = time.monotonic_ns()
            subprocess.run([sys.executable, "-c", "pass"], check=True)
            python_s.append(1e-9 * (time.monotonic_ns() - begin_ns))
            ground.arrivals.clear()
            with fly(ground, [picture(10 / RATE_HZ)]) as flight:
                first_ns = _first_arrival_ns(ground, flight)
                flight.end()
            ready_s.append(1e-9 * (flight.ready_ns - flight.begin_ns))
            first_s.append(1e-9 * (first_ns - flight.begin_ns))
    with Ground() as ground, fly(ground, [picture(0.1)], python=("-X", "importtime")) as flight:
        flight.end()
    modules, packages = imports(flight.errors)
    return {
        "repetitions": repetitions,
        "python_s": float(np.median(python_s)),
        "ready_s": float(np.median(ready_s)),
        "first_access_unit_s": float(np.median(first_s)),
        "import_s": sum(packages.values()),
        "packages_s": _largest(packages),
        "modules_s": _largest(modules),
    }


def imports(text: str) -> tuple[dict[str, float], dict[str, float]]:
    """Own import times, s, by module and by top-level package, from `-X importtime`."""
    modules: dict[str, float] = defaultdict(float)
    packages: dict[str, float] = defaultdict(float)
    for micros, name in _IMPORT.findall(text):
        top = name.partition(".")[0]
        standard = top in sys.stdlib_module_names
        modules[name] += int(micros) / 1e6
        packages["the standard library" if standard else top] += int(micros) / 1e6
    return modules, packages


def stream(seconds: float) -> dict[str, Any]:
    """Latency and memory of `seconds` at `RATE_HZ`, telemetry connected.

    Latency is from a picture's capture to the arrival of its last packet at a socket here; the test
    picture is captured when it leaves its source. Processor time is of all threads.
    """
    with Ground() as ground, fly(ground, [picture(seconds + _START_LIMIT_S), _SEND_ALL]) as flight:
        first_ns = _first_arrival_ns(ground, flight)
        used_s = _processor_s(flight.process.pid)
        count = len(ground.arrivals)
        while time.monotonic_ns() - first_ns < seconds * 1e9 and flight.process.poll() is None:
            time.sleep(0.05)
        arrivals = ground.arrivals[count:]
        used_s = _processor_s(flight.process.pid) - used_s
        memory = _memory_mb(flight.process.pid)
        flight.end(by_signal=True)
    latencies_ms = [1e-6 * (a.wall_ns - a.info.clock_ns) for a in arrivals if a.info]
    if not latencies_ms:
        raise FlightError(f"no frame came within {seconds:g} s")
    captured, gated, sent = flight.counters()
    return {
        "seconds": seconds,
        "frames": {"captured": captured, "gated": gated, "sent": sent},
        "received": len(ground.arrivals),
        "latency_ms": {
            "p50": float(np.percentile(latencies_ms, 50)),
            "p99": float(np.percentile(latencies_ms, 99)),
            "max": max(latencies_ms),
        },
        "processor_ms": 1e3 * used_s / len(arrivals),
        **memory,
    }


def _first_arrival_ns(ground: Ground, flight: BenchFlight) -> int:
    until_ns = flight.begin_ns + int(_START_LIMIT_S * 1e9)
    while not ground.arrivals:
        if flight.process.poll() is not None:
            flight.end()
            if not ground.arrivals:
                raise FlightError("the firmware ended without a frame")
        if time.monotonic_ns() > until_ns:
            raise FlightError(f"no frame came within {_START_LIMIT_S:g} s")
        time.sleep(0.005)
    return ground.arrivals[0].monotonic_ns


def _processor_s(process: int) -> float:
    """User and system time of a process so far."""
    schedstat = _proc(process, "stat").rpartition(")")[2].split()
    return (int(schedstat[11]) + int(schedstat[12])) / 100.0


def _memory_mb(process: int) -> dict[str, Any]:
    """What is resident, at most and now, and the mappings that most of it lies in, MB of 10^6."""
    status = {name: int(kb) * 1.024e-3 for name, kb in _STATUS.findall(_proc(process, "status"))}
    mappings: Counter[str] = Counter()
    name = ""
    for line in _proc(process, "smaps").splitlines():
        if match := _MAPPING.fullmatch(line):
            name = match[1].rpartition("/")[2] or "anonymous"
        elif line.startswith("Rss:"):
            mappings[name] += int(line.split()[1])
    return {
        "peak_mb": status["VmHWM"],
        "resident_mb": status["VmRSS"],
        "limit_mb": _LIMIT_MB,
        "mappings_mb": _largest({key: 1.024e-3 * kb for key, kb in mappings.items()}),
    }


def _largest(values: dict[str, float]) -> dict[str, float]:
    return dict(sorted(values.items(), key=lambda item: -item[1])[:8])


def _proc(process: int, name: str) -> str:
    try:
        return Path(f"/proc/{process}/{name}").read_text()
    except OSError:
        raise FlightError("the firmware ended while it was measured") from None
