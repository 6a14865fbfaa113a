"""`blimp serve` as its user runs it: the real program, its processes, and who looks at it."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from intake_stand import eventually, free_udp_port
from payload_process import PayloadProcess, free_port
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from ground_station.keys.authority import Authority
from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EstimateMessage

PAYLOADS = ("blimp-1", "blimp-2")
"""Those with a certificate, where a test names no others."""
ATRIUM = Path(__file__).parents[2] / "maps" / "atrium"
START_S = 60.0
STOP_S = 10.0
"""From SIGTERM until all are gone."""
_ASK_S = 0.1
_ACCIDENTS = ("Traceback", "panicked", "CRITICAL", "Exception ignored", "Segmentation")


def _tracking(view: Mapping[str, Any]) -> bool:
    estimate = view.get("estimate") or {}
    return estimate.get("state") == "TRACKING" and "estimate" not in view["stale"]


@dataclass(frozen=True)
class Process:
    """A process by its id and its start, so that another with the same id later is not it."""

    name: str
    pid: int
    started: str

    @property
    def living(self) -> bool:
        """Whether it runs; one that nobody reaped yet does not."""
        stat = _stat(self.pid)
        return bool(stat) and stat[0] != "Z" and stat[19] == self.started

    def memory_MB(self) -> float:
        """Its resident memory (proc(5), statm); 0 when it has gone."""
        with contextlib.suppress(OSError):
            pages = int(Path(f"/proc/{self.pid}/statm").read_text().split()[1])
            return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        return 0.0

    def cpu_s(self) -> float:
        """Processor time that it used so far, its own and the kernel's for it."""
        stat = _stat(self.pid)
        return sum(map(int, stat[11:13])) / os.sysconf("SC_CLK_TCK") if stat else 0.0


def _stat(pid: int) -> list[str]:
    """Fields of proc(5)'s stat from the state on; empty when there is no such process."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return []


def is_stopped(pid: int) -> bool:
    """Whether a process stands still by SIGSTOP."""
    return _stat(pid)[:1] == ["T"]


def process(name: str, pid: int) -> Process | None:
    """The process with an id now."""
    stat = _stat(pid)
    return Process(name, pid, stat[19]) if stat else None


def children(pid: int) -> dict[str, Process]:
    """The service's processes by their name in the table."""
    found: dict[str, Process] = {}
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                command = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
                name = _name(command)
                if name and (one := process(name, int(child))):
                    found[name] = one
    return found


def _name(command: list[str]) -> str:
    if "-m" not in command:
        return ""
    module, *arguments = command[command.index("-m") + 1 :]
    if module == "pi_firmware":
        return "demo-payload"
    if module == "ground_station.service.localizing":
        return f"localizer/{arguments[1]}"
    return module.rpartition(".")[2] if module.startswith("ground_station.service.") else ""


class Service:
    """`blimp serve` on ports and in folders of its own; a context manager that checks its end.

    It flies as it is installed: with an authority of its own, so that telemetry is mutual TLS and
    video SRTP; only the demo is without. A second station is given the first one's `authority`, and
    may take its map (not `map_named`). `place` is the private folder in memory in which a run's
    folder lies. What the service writes is kept over all its starts.
    """

    def __init__(
        self,
        folder: Path,
        *settings: str,
        payloads: Sequence[str] = PAYLOADS,
        demo: bool = False,
        name: str = "main",
        authority: Authority | None = None,
        map_named: bool = True,
    ) -> None:
        self.folder = folder
        self.recordings = folder / "recordings"
        self.place = Path(tempfile.mkdtemp(prefix="service-", dir="/dev/shm"))
        self.video, self.foxglove = free_udp_port(), free_port(socket.SOCK_STREAM)
        self.http = free_port(socket.SOCK_STREAM)
        telemetry = free_port(socket.SOCK_STREAM)
        self.endpoint = f"{'tcp' if demo else 'tls'}/127.0.0.1:{telemetry}"
        self._tcp = (self.http, self.foxglove, telemetry)
        self.url = f"http://127.0.0.1:{self.http}"
        blimp = str(Path(sys.executable).with_name("blimp"))
        self.command = [blimp, "serve"]
        if demo or map_named:
            self.command += ["--demo" if demo else f"--map={ATRIUM}"]
        for setting in (
            f"http.port={self.http}",
            f"foxglove.port={self.foxglove}",
            f"video.port={self.video}",
            f"telemetry.listen={json.dumps([self.endpoint])}",
            f"recording.folder={self.recordings}",
            "recording.min_free_MB=0",
            *settings,
        ):
            self.command += ["--set", setting]
        if not demo:
            self.authority = authority or Authority.create(folder / "keys")
            self.certificates = self.authority.add("ground", name)
            for payload_id in payloads if authority is None else ():
                self.authority.add("payload", payload_id)
            self.command += ["--set", f"telemetry.certificates={self.certificates}"]
            self.command += ["--set", f"name={name}"]
        self.client = httpx.Client(base_url=self.url, timeout=20.0)
        self.seen: set[Process] = set()
        """All processes that it was ever seen to have."""
        self._log = folder / "service.txt"
        self._asked_s = 0.0

    def __enter__(self) -> Service:
        try:
            self.start()
        except BaseException:
            self._clear()
            raise
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is not None:
                print(self.written())
            elif self.process.poll() is None:
                self.end()
        finally:
            self._clear()

    # Its life

    def launch(self, *more: str) -> subprocess.Popen[bytes]:
        """Starts the program; its output goes to the log."""
        environment = {k: v for k, v in os.environ.items() if k != "RUNTIME_DIRECTORY"}
        with self._log.open("a") as log:
            return subprocess.Popen(
                [*self.command, *more],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=environment | {"XDG_RUNTIME_DIR": str(self.place)},
            )

    def start(self) -> None:
        """Starts the service and waits for its page."""
        self.process = self.launch()
        eventually(self.answers, START_S)
        self.processes()

    def answers(self) -> bool:
        """Whether the page is there; fails when the service has ended."""
        assert self.process.poll() is None, self.written()
        with contextlib.suppress(httpx.HTTPError):
            return self.client.get("/healthz").status_code == 200
        return False

    def kill(self) -> None:
        """SIGKILL for the parent, as from the kernel when memory ends."""
        self.processes()
        self.process.kill()
        self.process.wait()

    def end(self) -> float:
        """SIGTERM; seconds until it had ended. Checks that all is in order and nothing is left."""
        self.processes()
        asked_s = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(4 * STOP_S)
        took_s = time.monotonic() - asked_s
        assert status == 0, f"status {status}: {self.written()}"
        self.assert_no_accident()
        self.assert_nobody_left()
        assert list(self.place.iterdir()) == []
        return took_s

    def written(self) -> str:
        """What all its processes wrote."""
        return self._log.read_text()

    def assert_no_accident(self) -> None:
        """No exception that nobody handled, in no process."""
        written = self.written()
        assert not [word for word in _ACCIDENTS if word in written], written

    def assert_nobody_left(self, limit_s: float = STOP_S) -> None:
        """No process runs any more, and the ports are free."""
        eventually(lambda: not [p for p in self.seen if p.living], limit_s)
        # A process killed is seen as ended a moment before the last of its threads has.
        eventually(lambda: all(_free(socket.SOCK_STREAM, port) for port in self._tcp), limit_s)
        eventually(lambda: _free(socket.SOCK_DGRAM, self.video), limit_s)

    def _clear(self) -> None:
        with contextlib.suppress(AttributeError):
            self.process.kill()
            self.process.wait()
        self.client.close()
        shutil.rmtree(self.place, ignore_errors=True)

    # What it tells

    def processes(self) -> dict[str, Process]:
        """Its processes now, without the parent."""
        found = children(self.process.pid)
        self.seen |= set(found.values())
        return found

    def parent(self) -> Process:
        """The program itself."""
        one = process("serve", self.process.pid)
        assert one is not None
        return one

    def state(self) -> dict[str, Any]:
        """The whole snapshot, ten times a second at most: who waits must not be the load."""
        time.sleep(max(0.0, self._asked_s + _ASK_S - time.monotonic()))
        self._asked_s = time.monotonic()
        try:
            answer = self.client.get("/api/state")
        except httpx.TransportError:  # an idle connection ended, or its process is restarted
            eventually(self.answers, START_S)
            answer = self.client.get("/api/state")
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def payload(self, payload_id: str) -> dict[str, Any]:
        """One payload's part of it; empty before it is known."""
        return dict(self.state()["payloads"].get(payload_id) or {})

    def tracking(self, payload_id: str) -> bool:
        """Whether it is localized now."""
        return _tracking(self.payload(payload_id))

    def has(self, payload_id: str) -> bool:
        """Whether a payload flies with it, and is localized there."""
        view = self.payload(payload_id)
        return _tracking(view) and bool(view["payload"]) and not view["payload"]["station"]

    def record(self, *, active: bool) -> None:
        """The dashboard's button."""
        answer = self.client.post("/api/recording", json={"active": active})
        assert answer.status_code == 200 and answer.json()["done"], answer.text

    @contextlib.contextmanager
    def bus(self) -> Iterator[Bus]:
        """A place on its bus."""
        (folder,) = self.place.glob("blimp-*")
        with Bus(folder, "test") as bus:
            yield bus

    # Who flies to it

    def fly(
        self,
        payload_id: str,
        folder: Path,
        *settings: str,
        rate_hz: float = 30.0,
        port: int = 0,
    ) -> PayloadProcess:
        """A payload's own program that flies the sample flight in a loop; a context manager.

        A lower rate takes fewer of the flight's frames; `port` is of a link before the service.
        Settings that are given go before these.
        """
        flight = os.path.relpath(ATRIUM / "flight.mcap")  # a picture shows what is streamed
        return PayloadProcess(
            folder,
            f"payload_id={payload_id}",
            f"camera.uri=replay:{flight}?loop=1&rate_hz={rate_hz:g}",
            f"camera.rate_hz={rate_hz:g}",
            f"link.port={port or self.video}",
            f"telemetry.connect={json.dumps([self.endpoint])}",
            f"telemetry.certificates={self.authority.of(f'payload.{payload_id}')}",
            *settings,
        )


def joined(folder: Path) -> tuple[Service, Service]:
    """Two stations of one authority, the second of which joins the first and takes its map."""
    for name in ("first", "second"):
        (folder / name).mkdir()
    port = free_port(socket.SOCK_STREAM)
    first = Service(folder / "first", f'fleet.listen=["tls/127.0.0.1:{port}"]')
    second = Service(
        folder / "second",
        f'fleet.join=["tls/127.0.0.1:{port}"]',
        f"map.shelf={folder / 'maps'}",
        name="spare",
        authority=first.authority,
        map_named=False,
    )
    return first, second


def _free(kind: socket.SocketKind, port: int) -> bool:
    """Whether nobody listens on a port."""
    with socket.socket(socket.AF_INET, kind) as tried:
        if kind == socket.SOCK_STREAM:  # connections that were closed may still linger
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):
            tried.bind(("127.0.0.1", port))
            return True
    return False


class Viewer:
    """A dashboard without a screen: takes all messages, and says of each picture that it came.

    It comes back by itself when the connection ends; a context manager.
    """

    def __init__(self, service: Service, payload_id: str = "") -> None:
        query = f"?payload={payload_id}" if payload_id else ""
        self._url = f"ws://127.0.0.1:{service.http}/api/live{query}"
        self.counts: dict[str, int] = {}
        """Messages by type."""
        self.events: list[dict[str, Any]] = []
        self.connections = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    def __enter__(self) -> Viewer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join(10)

    def _run(self) -> None:
        while not self._closing.wait(0.1):
            with (
                contextlib.suppress(OSError, WebSocketException, TimeoutError),
                connect(self._url, max_size=None, close_timeout=1) as live,
            ):
                self.connections += 1
                while not self._closing.is_set():
                    with contextlib.suppress(TimeoutError):
                        self._take(live.recv(timeout=0.5), live.send)

    def _take(self, message: str | bytes, send: Callable[[str], None]) -> None:
        if isinstance(message, str):
            document = json.loads(message)
            kind = document["type"]
            if kind == "event":
                self.events.append(document["event"])
        else:
            size = int.from_bytes(message[:4], "big")
            header = json.loads(message[4 : 4 + size])
            kind, sequence = header["type"], header["sequence"]
            send(json.dumps({"type": "ping", "sent_ms": 0, "sequence": sequence}))
        self.counts[kind] = self.counts.get(kind, 0) + 1


class Estimates:
    """Every estimate that is said on the bus, in few numbers, by payload."""

    def __init__(self, bus: Bus) -> None:
        self.latency_ms: dict[str, list[float]] = {}
        """From capture to pose; those with a pose and a known capture time."""
        self.done_ns: dict[str, list[int]] = {}
        self.states: dict[str, dict[str, int]] = {}
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, self._take)

    def _take(self, payload_id: str, note: EstimateMessage) -> None:
        states = self.states.setdefault(payload_id, {})
        states[note.state] = states.get(note.state, 0) + 1
        self.done_ns.setdefault(payload_id, []).append(note.done_ns)
        if note.capture_ns is not None and note.position_m is not None:
            latency_ms = 1e-6 * (note.done_ns - note.capture_ns)
            self.latency_ms.setdefault(payload_id, []).append(latency_ms)
