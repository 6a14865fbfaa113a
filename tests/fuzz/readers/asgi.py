"""The dashboard's application, asked without a socket: requests as uvicorn would hand them over."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pieces import scratch

from ground_station.service import bus_messages
from ground_station.service.settings import (
    HttpSettings,
    MapSettings,
    RecordingSettings,
    Run,
    StationSettings,
)
from ground_station.service.web.access import Buckets
from ground_station.service.web.app import Web, build

ATRIUM = Path(__file__).parents[3] / "maps" / "atrium"
PORT = 8080


class Bus:
    """A bus without others: what is asked is done at once."""

    dropped = 0

    def __init__(self) -> None:
        self.takes: dict[str, list[Callable[[str, Any], None]]] = {}

    def subscribe(self, kind: str, _: type, take: Callable[[str, Any], None]) -> None:
        """Who listens to a kind."""
        self.takes.setdefault(kind, []).append(take)

    def publish(self, *_: object) -> None:
        """To nobody."""

    def query(self, *_: object, **__: object) -> Mapping[str, Any]:
        """Whatever it was."""
        return {"done": True, "reason": ""}


def application() -> Web:
    """A station with a payload, a map's text and a recording that is none; its loop is not run."""
    folder = scratch("web")
    (folder / "recordings").mkdir()
    (folder / "recordings" / "a.mcap").write_bytes(b"no recording")
    (folder / "maps" / "atrium").mkdir(parents=True)
    for name in ("map.toml", "floorplan.yaml", "floorplan.png"):
        if (ATRIUM / name).is_file():
            shutil.copy(ATRIUM / name, folder / "maps" / "atrium")
    station = StationSettings(
        map=MapSettings(folder=str(folder / "maps" / "atrium"), shelf=str(folder / "maps")),
        recording=RecordingSettings(folder=str(folder / "recordings")),
        http=HttpSettings(port=PORT),
    )
    web = build(Run(station, started_ns=time.time_ns()), folder, Bus(), None)  # type: ignore[arg-type]
    web.access.posts = Buckets(1e9, 10**9)
    web.snapshot.payload("blimp-1", bus_messages.PayloadMessage(True, time.time_ns(), 7))
    return web


async def ask(web: Web, method: str, target: bytes, headers: list[Any], body: bytes) -> int:
    """The answer's status; raises whatever the application lets through."""
    path, _, query = target.partition(b"?")
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method,
        "scheme": "http", "path": path.decode("latin-1"), "raw_path": path, "query_string": query,
        "root_path": "", "headers": [(b"host", b"127.0.0.1:%d" % PORT), *headers],
        "client": ("127.0.0.1", 50_000), "server": ("127.0.0.1", PORT), "state": {},
    }  # fmt: skip
    given, statuses = [body[: len(body) // 2], body[len(body) // 2 :]], []
    ended = asyncio.Event()

    async def receive() -> dict[str, Any]:
        if given:
            return {"type": "http.request", "body": given.pop(0), "more_body": bool(given)}
        await ended.wait()
        return {"type": "http.disconnect"}

    async def send(message: Mapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            statuses.append(int(message["status"]))
        elif not message.get("more_body"):
            ended.set()

    await web.guarded(scope, receive, send)
    return statuses[0]
