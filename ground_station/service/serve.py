"""The service's parent: the bus, the table of processes, and what systemd is told."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import socket
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from ground_station.errors import InputError
from ground_station.map.folder import check_is_map
from ground_station.service import bus_messages, processes
from ground_station.service.bus import Bus, Router
from ground_station.service.bus_messages import EventMessage, PayloadMessage, ProcessMessage
from ground_station.service.processes import Children
from ground_station.service.settings import (
    DEMO_PAYLOAD,
    RUN_FILE,
    Run,
    StationSettings,
    write_run,
)
from pi_firmware.wire import config, scouting
from pi_firmware.wire.systemd import Notifier

_STEP_S = 0.1
_GONE_S = 60.0
_FEED_S = 2.0


def serve(settings: StationSettings, stop: threading.Event, *, demo: Path | None = None) -> None:
    """Runs the service until `stop` is set; `demo` is a recording that is played again and again.

    Raises a `BlimpError` with one line when it cannot start.
    """
    _check_map(Path(settings.map.folder))
    notifier = Notifier()
    with run_folder() as folder:
        write_run(folder, Run(settings, demo=demo is not None, started_ns=time.time_ns()))
        payload = _demo_config(folder, settings, demo) if demo else None
        with contextlib.closing(Router(folder)), Bus(folder, "station") as bus:
            parent = _Parent(folder, settings, bus, payload)
            try:
                parent.run(stop, notifier)
            finally:
                notifier.stopping()
                parent.children.close()


class _Parent:
    """Takes up payloads with a localizer each, and keeps all processes alive."""

    def __init__(
        self, folder: Path, settings: StationSettings, bus: Bus, demo: Path | None
    ) -> None:
        self._folder, self._settings, self._bus = folder, settings, bus
        self._lock = threading.Lock()
        self._here_s: dict[str, float] = {}
        self._elsewhere_s: dict[str, float] = {}
        specs = processes.table(folder, foxglove=settings.foxglove.enabled, demo=demo)
        self.children = Children(specs, self._report)
        bus.subscribe(
            bus_messages.PROCESS,
            ProcessMessage,
            lambda _, note: self.children.heartbeat(note.name, note.pid),
        )
        bus.subscribe(bus_messages.PAYLOAD, PayloadMessage, self._hear_payload)

    def run(self, stop: threading.Event, notifier: Notifier) -> None:
        """Until `stop`; systemd's watchdog is fed while restarts of a process may still help."""
        ready, fed_s = False, 0.0
        while not stop.wait(_STEP_S):
            self.children.step()
            self._follow_payloads()
            self._bus.heartbeat()
            now_s = time.monotonic()
            if now_s - fed_s > _FEED_S and self.children.hopeful():
                fed_s = now_s
                ready = ready or (self.children.living() and notifier.ready())
                notifier.alive()

    def _hear_payload(self, payload_id: str, note: PayloadMessage) -> None:
        if note.alive:
            with self._lock:
                seen_s = self._elsewhere_s if note.station else self._here_s
                seen_s[payload_id] = time.monotonic()

    def _follow_payloads(self) -> None:
        """A localizer for each payload that flies here, and for a minute after it has gone.

        Some stand by for payloads of other stations, one for every two processors: a payload whose
        station falls silent is found sooner by them.
        """
        now_s = time.monotonic()
        with self._lock:
            here, elsewhere = dict(self._here_s), dict(self._elsewhere_s)
        most = self._settings.payloads.most
        wanted = _lately(here, now_s)[:most]
        others = sorted(
            set(_lately(elsewhere, now_s)) - set(wanted),
            # Each station begins with another one of them.
            key=lambda name: zlib.crc32(f"{self._settings.name}/{name}".encode()),
        )
        standing_by = max(1, (os.cpu_count() or 1) // 2)
        wanted += others[: min(most - len(wanted), standing_by)]
        for payload_id in {*here, *elsewhere}:
            spec = processes.localizer(self._folder, payload_id)
            if payload_id in wanted:
                self.children.add(spec)
            elif spec.name in self.children:
                self.children.remove(spec.name)

    def _report(self, text: str) -> None:
        print(f"blimp serve: {text}", file=sys.stderr, flush=True)
        note = EventMessage(
            time.time_ns(), "station", bus_messages.WARNING, "process-restarted", text
        )
        with contextlib.suppress(Exception):  # the bus may be what fails
            self._bus.publish(bus_messages.EVENT, bus_messages.STATION, note)


def _lately(seen_s: dict[str, float], now_s: float) -> list[str]:
    """Those seen within a minute, the newest first."""
    names = [name for name, at_s in seen_s.items() if now_s - at_s <= _GONE_S]
    return sorted(names, key=lambda name: -seen_s[name])


@contextlib.contextmanager
def run_folder() -> Iterator[Path]:
    """A private folder in memory, gone with the service; systemd's own where it gives one."""
    for place in (
        os.environ.get("RUNTIME_DIRECTORY"),
        os.environ.get("XDG_RUNTIME_DIR"),
        "/dev/shm",
    ):
        if place and os.access(place, os.W_OK):
            break
    else:
        place = tempfile.gettempdir()
    _sweep(Path(place))
    folder = Path(tempfile.mkdtemp(prefix="blimp-", dir=place))
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)  # before it has a RUN_FILE; it ends with this process
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _sweep(place: Path) -> None:
    """Removes the folders of services that were killed: nobody holds their locks any more."""
    for run in place.glob(f"blimp-*/{RUN_FILE}"):
        with contextlib.suppress(OSError):
            lock = os.open(run.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_uid == os.geteuid():
                    shutil.rmtree(run.parent, ignore_errors=True)
            finally:
                os.close(lock)


def check(settings: StationSettings) -> None:
    """Raises a `BlimpError` for what the service refuses at its start, ports that are held aside.

    Those are `blimp doctor`'s: they are held by the service itself where it runs.
    """
    from ground_station.service.cameras import camera_of
    from ground_station.service.web.access import read_token
    from ground_station.stream.srtp import load_keys
    from pi_firmware.wire import credentials

    telemetry = settings.telemetry
    _check_map(Path(settings.map.folder))
    camera_of(settings.map, settings.map.folder)
    if telemetry.certificates:
        credentials.load(telemetry.certificates)
        load_keys(telemetry.certificates)
    interfaces = [name for _, name in socket.if_nameindex()]
    scouting.check(
        "", telemetry.discoverable, telemetry.listen, certified=bool(telemetry.certificates)
    )
    if telemetry.discoverable and telemetry.discoverable not in interfaces:
        raise InputError(
            f"telemetry.discoverable is '{telemetry.discoverable}': no such interface"
            f" (there are: {', '.join(interfaces)})"
        )
    read_token(settings.http)


def _check_map(folder: Path) -> None:
    """Raises a `BlimpError` for what no localizer could use.

    The localizers read the map itself: this process stays small for as long as the service runs.
    """
    check_is_map(folder)
    if config.read(folder / "map.toml").get("frame") != "world":
        raise InputError(f"{folder}: it is not registered to a floor plan; see blimp map register")


def _demo_config(folder: Path, settings: StationSettings, recording: Path) -> Path:
    """The configuration of a payload that plays a recording to this station."""
    import tomli_w

    from pi_firmware.wire.recording import RecordingReader

    camera = RecordingReader(recording).calibration()
    if camera is None:
        raise InputError(f"{recording}: it carries no camera calibration")
    document = {
        "payload_id": DEMO_PAYLOAD,
        "camera": {
            "uri": f"replay:{recording.resolve()}?loop=1",
            "width_px": camera.width,
            "height_px": camera.height,
            "rate_hz": 30.0,
        },
        "link": {"port": settings.video.port},
        "telemetry": {"connect": list(settings.telemetry.listen)},
    }
    path = folder / "demo-payload.toml"
    path.write_bytes(tomli_w.dumps(document).encode())
    return path
