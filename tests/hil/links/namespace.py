"""Payload and ground as two hosts: a network namespace for the firmware, a cable to this one.

Off loopback nobody speaks without keys, so that a flight gets its own: mutual TLS and SRTP. What
the cable does to packets is the kernel's netem, where there is one; an outage is the cable pulled.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from links.proxy import told

from ground_station.errors import GroundStationError
from ground_station.keys.authority import Authority
from ground_station.replay.cases.case import Link
from ground_station.replay.cases.outcome import Outage
from ground_station.replay.rig import LOOPBACK, FirmwareProcess, Rig
from ground_station.service.settings import TelemetrySettings, VideoSettings

_TOOLS = ("ip", "tc", "unshare", "nsenter")
_LIMIT_S = 30.0
_PACKET_BYTES = 1400
_LOADED_S = 240.0


class NamespaceError(GroundStationError):
    """The namespace or its cable cannot be made; one line."""


class NamespaceLink:
    """One flight's two hosts; a context manager. `stand` is what is to be flown on."""

    kind = "namespace"

    def __init__(self, link: Link) -> None:
        self._link = link
        self._stack = contextlib.ExitStack()
        self._outages: list[Outage] = []
        self._flying = threading.Event()

    def lacks(self) -> str:
        """Why it cannot be flown here, in words; "" when it can."""
        if os.geteuid() != 0:
            return "network namespaces need root"
        if missing := [tool for tool in _TOOLS if shutil.which(tool) is None]:
            return f"{', '.join(missing)}: not installed"
        if _tried("unshare", "-n", "true"):
            return "this machine allows no network namespace"
        words = netem(self._link)
        if isinstance(words, str):
            return words
        script = f"ip link set lo up && tc qdisc add dev lo root netem {' '.join(words)}"
        if words and _tried("unshare", "-n", "sh", "-c", script):
            return "this kernel has no sch_netem, or another one"
        return ""

    def __enter__(self) -> NamespaceLink:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="blimp-netns-")))
            self._ground, self._payload = _keys(folder / "keys")
            # It holds the namespace, ends with its standard input, and all with it.
            self._host = stack.enter_context(Holder())
            number = os.getpid()
            self._address = f"10.{200 + number // 250 % 50}.{number % 250}."
            self._cable = f"hil{self._host.pid}"
            _ip("link", "add", self._cable, "type", "veth", "peer", "name", "eth0", "netns",
                str(self._host.pid))  # fmt: skip
            _ip("address", "add", f"{self._address}1/30", "dev", self._cable)
            _ip("link", "set", self._cable, "up")
            self._host.run("ip", "link", "set", "lo", "up")
            self._host.run("ip", "address", "add", f"{self._address}2/30", "dev", "eth0")
            self._host.run("ip", "link", "set", "eth0", "up")
            if words := netem(self._link):
                self._host.run("tc", "qdisc", "add", "dev", "eth0", "root", "netem", *words)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def stand(self) -> Rig:
        """The ground's ends on the cable, and the firmware in its namespace."""
        host = f"{self._address}1"
        return Rig(
            payload=self._fly,
            link=self,
            video=VideoSettings(host=host, port=0),
            telemetry=TelemetrySettings(listen=[f"tls/{host}:0"], certificates=str(self._ground)),
            on_first_frame=self._flying.set,
        )

    @contextlib.contextmanager
    def __call__(self, receiver_port: int) -> Iterator[int]:
        ended = threading.Event()
        thread = threading.Thread(target=self._pull, args=(ended,), daemon=True)
        thread.start()
        try:
            yield receiver_port
        finally:
            ended.set()
            thread.join()

    def injected(self) -> str:
        """What it was told to do, in one line."""
        return told(self._link)

    def counts(self) -> dict[str, int]:
        """The kernel's, of the ground's end of the cable; empty without one."""
        folder = Path("/sys/class/net") / getattr(self, "_cable", "none") / "statistics"
        names = ("rx_packets", "rx_dropped", "tx_packets")
        with contextlib.suppress(OSError, ValueError):
            return {name: int((folder / name).read_text()) for name in names}
        return {}

    def outages(self) -> list[Outage]:
        """When the cable was pulled, on this machine's wall clock."""
        return list(self._outages)

    @contextlib.contextmanager
    def _fly(self, config: dict[str, Any], folder: Path) -> Iterator[FirmwareProcess]:
        config = {
            **config,
            "link": {**config["link"], "host": f"{self._address}1"},
            "telemetry": {**config["telemetry"], "certificates": str(self._payload)},
        }
        with FirmwareProcess(config, folder, self._host.prefix) as firmware:
            _wait_loaded(firmware, folder / "firmware.log")
            yield firmware

    def _pull(self, ended: threading.Event) -> None:
        """Pulls the cable at the case's times from the first frame on."""
        while not self._flying.wait(0.01):
            if ended.is_set():
                return
        first_s = time.monotonic()
        for at_s, for_s in self._link.outages:
            if ended.wait(max(0.0, first_s + at_s - time.monotonic())):
                return
            begin_ns = time.time_ns()
            _ip("link", "set", self._cable, "down")
            over = ended.wait(max(0.0, first_s + at_s + for_s - time.monotonic()))
            _ip("link", "set", self._cable, "up")
            self._outages.append(Outage(begin_ns, time.time_ns()))
            if over:
                return


class Holder:
    """A process that is alone in a network namespace; a context manager."""

    @property
    def prefix(self) -> tuple[str, ...]:
        """What runs a program inside."""
        return ("nsenter", "-t", str(self.pid), "-n")

    def run(self, *words: str) -> str:
        """Runs a program inside; its output. Raises `NamespaceError` with one line."""
        return run(*self.prefix, *words)

    def __enter__(self) -> Holder:
        self._process = subprocess.Popen(
            ["unshare", "-n", "sh", "-c", "echo ready; exec cat"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        assert self._process.stdout is not None
        if self._process.stdout.readline() != b"ready\n":
            self.__exit__()
            raise NamespaceError("unshare -n: no network namespace")
        self.pid = self._process.pid
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


def _wait_loaded(firmware: FirmwareProcess, log: Path) -> None:
    """Waits for its first words; raises a `GroundStationError` when it fails or takes too long."""
    until_s = time.monotonic() + _LOADED_S
    while not log.read_bytes().startswith(b"payload "):
        firmware.check()
        if not firmware.running() or time.monotonic() > until_s:
            raise NamespaceError(f"the firmware did not start within {_LOADED_S:g} s")
        time.sleep(0.05)


def netem(link: Link) -> list[str] | str:
    """The link's settings in netem's words (tc-netem(8)); why not, for what it does otherwise."""
    if link.reorder:
        return "netem reorders by a delay and not by packets; kind 'proxy' does"
    if link.loss and link.burst_start:
        return "netem has either 'loss' or bursts, not both; kind 'proxy' has"
    words: list[str] = []
    if link.delay_s or link.jitter_s:
        half_s = link.jitter_s / 2  # netem's jitter goes both ways
        words += ["delay", f"{1e3 * (link.delay_s + half_s):g}ms", f"{1e3 * half_s:g}ms"]
    if link.loss:
        words += ["loss", "random", f"{100 * link.loss:g}%"]
    if link.burst_start:
        shares = (link.burst_start, link.burst_end, link.burst_loss, 0.0)
        words += ["loss", "gemodel", *(f"{100 * share:g}%" for share in shares)]
    if link.duplicate:
        words += ["duplicate", f"{100 * link.duplicate:g}%"]
    if link.rate_kbps:
        queue = max(1, round(1e3 * link.rate_kbps * link.queue_s / 8 / _PACKET_BYTES))
        words += ["rate", f"{link.rate_kbps:g}kbit", "limit", str(queue)]
    return [*words, "seed", str(link.seed)] if words else []


def _keys(folder: Path) -> tuple[Path, Path]:
    """Throw-away certificate folders of ground and payload."""
    authority = Authority.create(folder)
    ground = authority.add("ground", "main")
    payload = authority.add("payload", LOOPBACK.payload_id)
    return ground, payload


def _ip(*words: str) -> None:
    run("ip", *words)


def run(*words: str) -> str:
    """Runs a program; its output. Raises `NamespaceError` with one line."""
    done = subprocess.run(
        words, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=_LIMIT_S,
        check=False,
    )  # fmt: skip
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no word"])[-1]
        raise NamespaceError(f"{' '.join(words[:4])}: {said}")
    return done.stdout


def _tried(*words: str) -> bool:
    """Whether a command fails."""
    return bool(subprocess.run(words, capture_output=True, check=False).returncode)
