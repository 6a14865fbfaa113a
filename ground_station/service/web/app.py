"""The application: its rooms put together, and the gate around them."""

from __future__ import annotations

import asyncio
import contextlib
import mimetypes
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from ground_station import __version__
from ground_station.service import bus_messages
from ground_station.service.bus import Bus
from ground_station.service.bus_messages import EstimateMessage
from ground_station.service.fleet.fleet import Fleet
from ground_station.service.fleet.shelf import Elsewhere
from ground_station.service.settings import Run
from ground_station.service.web import (
    control,
    guide,
    jobs,
    live,
    maps,
    pages,
    playback,
    problems,
    recordings,
)
from ground_station.service.web.access import Access
from ground_station.service.web.guard import Guard
from ground_station.service.web.metrics import Metrics
from ground_station.service.web.metrics import router as router_of_state
from ground_station.service.web.problems import NotFound
from ground_station.service.web.snapshot import Snapshot
from ground_station.service.web.video import Video

STATIC = Path(__file__).with_name("static")
_DESCRIPTION = """\
State, control and recordings of a blimp ground station. Times are nanoseconds of the station's wall
clock, lengths metres in the map's frame (x along the floor plan, z up), poses wTc with quaternions
x, y, z, w; a covariance's order is rotation, then translation.

An error is {"detail": one line}. Beyond loopback each request needs "Authorization: Bearer TOKEN"
or a session from /login. A request that changes something must not carry another site's Origin.

Live, over the WebSocket /api/live?payload=ID: text messages {"type": hello, state, estimate, event,
alarm, recording, gone, selected or pong, …}; binary ones are pictures: a header's length (4 bytes,
big-endian), the header in JSON, a JPEG. It takes {"type": "select", "payload"}, {"type": "video",
"on"}, {"type": "shown", "sequence", "shown_ms"} and {"type": "ping", "sent_ms"}.

A recording is played back by the same messages over /api/recordings/FILE/play, another
station's over /api/stations/STATION/recordings/FILE/play. Its hello has `tape`
(begin_ns, length_s, marks), its state `playback` (at_s, playing, rate); it also takes
{"type": "play", "on"}, {"type": "seek", "at_s"} and {"type": "rate", "rate"}.
"""
# The system's own table may lack these, and scripts of another type are not run.
_TYPES = {
    ".js": "text/javascript", ".mjs": "text/javascript", ".css": "text/css",
    ".svg": "image/svg+xml", ".json": "application/json", ".woff2": "font/woff2",
    ".webmanifest": "application/manifest+json",
}  # fmt: skip


@dataclass
class Web:
    """The application with what its process drives: `guarded` is what is served."""

    app: FastAPI
    guarded: ASGIApp
    live: live.Live
    snapshot: Snapshot
    metrics: Metrics
    access: Access
    video: Video
    loops: list[asyncio.AbstractEventLoop]

    def loop(self) -> asyncio.AbstractEventLoop:
        """The loop that it is served on."""
        return self.loops[0]


def build(run: Run, folder: Path, bus: Bus, token: str | None, *, static: Path = STATIC) -> Web:
    """Puts the application together; it hears the bus while it is served."""
    settings = run.station
    snapshot = Snapshot(run, __version__)
    snapshot.keep_events(folder / "events.jsonl")
    job = jobs.Jobs(folder)
    snapshot.job = job.state
    metrics = Metrics(snapshot)
    access = Access(settings.http, token)

    def show(payload_id: str, message: bytes) -> None:
        with contextlib.suppress(RuntimeError, IndexError):  # before the loop, or after it
            loops[0].call_soon_threadsafe(viewers.picture, payload_id, message)

    fleet = None
    if settings.fleet.listen or settings.fleet.join:
        fleet = Fleet(settings, bus, __version__, show)
        snapshot.fleet = fleet.document
    hub = fleet or bus

    def picture(payload_id: str, message: bytes) -> None:
        show(payload_id, message)
        if fleet is not None:
            fleet.picture(payload_id, message)

    loops: list[asyncio.AbstractEventLoop] = []
    video = Video(folder, settings.http.video_rate_hz, settings.http.jpeg_quality, picture)
    viewers = live.Live(snapshot, metrics, settings.http, video)
    snapshot.evicted = metrics.forget
    metrics.viewers = lambda: viewers.viewers
    metrics.bus_dropped = lambda: bus.dropped
    fates = ("encoded", "skipped", "gone", "failed")
    metrics.video = lambda: {fate: getattr(video, fate) for fate in fates}

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        loops[:] = [asyncio.get_running_loop()]
        snapshot.listen(hub)
        bus.subscribe(bus_messages.ESTIMATE, EstimateMessage, metrics.estimate)
        viewers.listen(hub, loops[0])
        ticking = asyncio.create_task(viewers.tick())
        try:
            yield
        finally:
            ticking.cancel()
            video.close()
            job.close()
            if fleet is not None:
                fleet.close()

    app = FastAPI(
        title="Blimp ground station",
        version=__version__,
        description=_DESCRIPTION,
        openapi_url="/api/openapi.json",
        docs_url=None,  # these would load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
        responses=problems.EVERYWHERE,
        redirect_slashes=False,
    )
    problems.install(app)
    shelf = maps.Maps(settings.map)
    recorded = recordings.Recordings(Path(settings.recording.folder), snapshot.recorded_now)
    app.include_router(router_of_state(snapshot, metrics))
    app.include_router(maps.router(shelf))
    app.include_router(control.router(control.Control(hub, snapshot), shelf, fleet))
    app.include_router(recordings.router(recorded))
    if fleet is not None:
        fleet.shelf = recorded
    elsewhere = _elsewhere(fleet)
    named = fleet.named if fleet else lambda note: note
    app.include_router(recordings.elsewhere(elsewhere))
    app.include_router(jobs.router(guide.Guide(settings, shelf, recorded), job, snapshot))
    app.include_router(live.router(viewers, access.sessions.holds))
    app.include_router(
        playback.router(recorded, elsewhere, named, run, __version__, access.sessions.holds)
    )
    app.include_router(pages.router(access, settings.name))
    app.include_router(pages.docs_router(app))
    _serve_dashboard(app, static)
    guarded = Guard(app, access, metrics.answers)
    return Web(app, guarded, viewers, snapshot, metrics, access, video, loops)


def _elsewhere(fleet: Fleet | None) -> Callable[[str], Elsewhere]:
    def shelf(station: str) -> Elsewhere:
        if fleet is None or not fleet.where.knows(station):
            raise NotFound(f"no station {station!r} flies beside this one")
        return fleet.shelf_of(station)

    return shelf


def static_files(static: Path) -> StaticFiles:
    """The files of the folder `static`, and the scripts that other pages share with it."""
    return StaticFiles(directory=static, packages=[("ground_station.presentation", "web")])


def _serve_dashboard(app: FastAPI, static: Path) -> None:
    """The page and what it loads: its own folder, and the scripts that other pages share."""
    for ending, kind in _TYPES.items():
        mimetypes.add_type(kind, ending)

    @app.get("/", include_in_schema=False)
    def dashboard() -> Response:
        page = static / "index.html"
        if not page.is_file():
            raise HTTPException(404, "this installation has no dashboard; see /api/docs")
        return FileResponse(page, media_type="text/html")

    if static.is_dir():
        app.mount("/static", static_files(static), name="static")
