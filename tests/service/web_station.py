"""A station for tests of the web process: the test says its notes, on a real bus or on none."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from process_stand import program
from station_notes import (
    HEIGHT,
    PAYLOAD,
    WIDTH,
    SilentBus,
    estimate,
    event,
    frame,
    payload,
    process,
    recording,
    say_all,
)
from waiting import eventually

from ground_station.service.pictures import PictureWriter
from ground_station.service.settings import (
    HttpSettings,
    MapSettings,
    PayloadSettings,
    RecordingSettings,
    Run,
    StationSettings,
)
from ground_station.service.web.app import Web, build
from ground_station.service.web.server import listen, server

with warnings.catch_warnings():  # of a client that starlette would rather have
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient as TestClient

__all__ = [
    "HEIGHT", "PAYLOAD", "WIDTH", "SilentBus", "estimate", "event", "eventually", "frame",
    "payload", "process", "recording", "say_all",
]  # fmt: skip
ATRIUM = Path(__file__).parents[2] / "maps" / "atrium"
HERE = "http://127.0.0.1:8080"
TOKEN = "a-token-of-more-than-20-characters"


def run_of(folder: Path, *, shelf: Path = ATRIUM.parent, **http: Any) -> Run:
    """Settings with the sample map, whose recordings lie in folder/recordings."""
    (folder / "recordings").mkdir(exist_ok=True)
    station = StationSettings(
        map=MapSettings(folder=str(shelf / "atrium"), shelf=str(shelf)),
        payloads=PayloadSettings(apart_m=0.0),  # two that fly one recording are near
        recording=RecordingSettings(folder=str(folder / "recordings")),
        http=HttpSettings(**{"port": 0, **http}),
    )
    return Run(station, started_ns=time.time_ns())


@contextlib.contextmanager
def application(folder: Path, token: str | None = None) -> Iterator[tuple[Any, Any, Any]]:
    """A client of the application, the bus that it hears, and what its process drives."""
    bus = SilentBus()
    web = build(run_of(folder), folder, bus, token)
    client = TestClient(web.guarded, HERE, follow_redirects=False, raise_server_exceptions=False)
    with client:
        say_all(bus.put)
        yield client, bus, web


def texture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)


def write_token(folder: Path, text: str = TOKEN, mode: int = 0o600) -> Path:
    path = folder / "token"
    path.write_text(text)
    path.chmod(mode)
    return path


def ring(folder: Path) -> PictureWriter:
    return PictureWriter(folder, PAYLOAD)


@contextlib.contextmanager
def serving(web: Web, port: int = 0) -> Iterator[int]:
    """The application behind the real server, in a thread; its port of loopback."""
    with listen("127.0.0.1", port) as sock:
        serving = server(web.guarded)
        thread = threading.Thread(target=lambda: asyncio.run(serving.serve([sock])), daemon=True)
        thread.start()
        eventually(lambda: serving.started)
        yield sock.getsockname()[1]
        web.loop().call_soon_threadsafe(web.live.close)
        serving.should_exit = True
        thread.join(10.0)
        assert not thread.is_alive()


def write_recording(path: Path, seconds: float = 2.0, maps: Iterable[str] = ()) -> None:
    """The smallest that is one: it has a length, and says in which maps it was flown."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        mcap = Writer(file)
        mcap.start()
        for name in maps:
            mcap.add_metadata(f"map {name}", {"name": name})
        channel = mcap.register_channel("x", "json", 0)
        for at_ns in (0, int(seconds * 1e9)):
            mcap.add_message(channel, at_ns, b"{}", at_ns)
        mcap.finish()


@contextlib.contextmanager
def web_process(folder: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The real process on the run in a folder, with its port."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with program("web", str(folder), **pipes) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("dashboard: http://"), (line, process.stderr and process.poll())
        yield process, int(line.rstrip("/\n").rpartition(":")[2])
