"""The page on loopback, under an address that nobody can guess, until it is saved or ended."""

from __future__ import annotations

import functools
import os
import secrets
import socket
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import uvicorn
from fastapi import BackgroundTasks, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import HTMLResponse, JSONResponse, Response

from ground_station.errors import MapError
from ground_station.map import store
from ground_station.mapping.registration.distances import Distances
from ground_station.mapping.registration.page.session import RegistrationSession
from ground_station.mapping.registration.plan import load_plan
from ground_station.mapping.registration.registration import Registration
from pi_firmware.wire.errors import BlimpError

_HERE = Path(__file__).parent
_BODY_BYTES = 16 * 1024
_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}

_Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
_Name = Annotated[str, Field(max_length=200)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Click(_Strict):
    """A click in the top view, map units."""

    x: _Number
    y: _Number
    radius: _Number
    low: _Number
    high: _Number
    offers: bool = True


class Place(_Strict):
    """A click on the plan, pixels."""

    u: _Number
    v: _Number


class Scale(_Strict):
    """Two points of the plan, pixels, and how far apart they are."""

    one: Place
    other: Place
    length_m: _Number


class Named(_Strict):
    """A pick."""

    name: _Name


class Heights(_Strict):
    """Heights in the top view, map units."""

    low: _Number
    high: _Number


class Decision(_Strict):
    """What a person says to the fit to the walls."""

    accept: bool


class Upright(_Strict):
    """Where up comes from, a correction by hand, and the height of a level."""

    source: _Name
    tilt_x_deg: _Number = 0.0
    tilt_y_deg: _Number = 0.0
    level: _Number | None = None
    height_m: _Number = 0.0


def build(session: RegistrationSession, token: str, done: Callable[[], None]) -> FastAPI:
    """The application; `done` is called once the map is saved and the answer is on its way."""
    nonce = secrets.token_urlsafe(16)
    html = _page(nonce)
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False)
    root = f"/{token}"

    @app.middleware("http")
    async def guard(request: Request, call_next: Any) -> Response:
        host = request.headers.get("host", "").rpartition(":")[0]
        length = request.headers.get("content-length", "0")
        if host not in ("127.0.0.1", "localhost"):  # a name of somebody else's that leads here
            answer: Response = _refusal(403, "this page is for this machine only")
        elif request.method == "POST" and not (
            length.isdecimal()
            and int(length) <= _BODY_BYTES
            and "transfer-encoding" not in request.headers
        ):
            answer = _refusal(413, f"a body has at most {_BODY_BYTES} bytes")
        else:
            answer = await call_next(request)
        for name, value in _HEADERS.items():
            answer.headers.setdefault(name, value)
        answer.headers.setdefault(
            "content-security-policy",
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; "
            "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'",
        )
        return answer

    @app.exception_handler(BlimpError)
    async def refused(_: Request, error: BlimpError) -> Response:
        return _refusal(409, str(error).removeprefix("registration: "))

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> Response:
        where = ".".join(str(part) for part in error.errors()[0].get("loc", ())[1:])
        return _refusal(422, f"{where or 'the request'}: not what is expected")

    @app.get(f"{root}/", response_class=HTMLResponse)
    def page() -> str:
        return html

    @app.get(f"{root}/state")
    def state() -> Any:
        return session.state()

    @app.get(f"{root}/points")
    def points() -> Response:
        return Response(session.points(), media_type="application/octet-stream")

    @app.get(f"{root}/plan.png")
    def plan() -> Response:
        return Response(session.picture(), media_type="image/png")

    def changes(apply: Callable[..., None]) -> None:
        """A route of the function's name: it changes the session and answers with the state."""

        @functools.wraps(apply)
        def answer(*args: Any, **asked: Any) -> Any:
            apply(*args, **asked)
            return session.state()

        app.post(f"{root}/{apply.__name__}")(answer)

    changes(session.snap)
    changes(session.turn)

    @changes
    def click(asked: Click) -> None:
        at = np.array([asked.x, asked.y])
        session.click(at, asked.radius, asked.low, asked.high, asked.offers)

    @changes
    def place(asked: Place) -> None:
        session.place(np.array([asked.u, asked.v]))

    @changes
    def redo(asked: Named) -> None:
        session.redo(asked.name)

    @changes
    def delete(asked: Named) -> None:
        session.delete(asked.name)

    @changes
    def scale(asked: Scale) -> None:
        one, other = (np.array([place.u, place.v]) for place in (asked.one, asked.other))
        session.scale(one, other, asked.length_m)

    @changes
    def upright(asked: Upright) -> None:
        tilt = asked.tilt_x_deg, asked.tilt_y_deg
        session.upright(asked.source, tilt, asked.level, asked.height_m)

    @changes
    def walls(asked: Heights) -> None:
        session.propose(asked.low, asked.high)

    @changes
    def decide(asked: Decision) -> None:
        session.decide(asked.accept)

    @changes
    def save(tasks: BackgroundTasks) -> None:
        session.save()
        tasks.add_task(done)  # once the answer is out

    return app


def serve(
    folder: Path,
    *,
    plan: str | None,
    resolution_m: float | None,
    distances: Distances | None,
    port: int,
    browser: bool,
    seed: int,
) -> Registration | None:
    """Serves the page until the map is saved or Ctrl-C; what was registered, None where nothing.

    Raises `BlimpError` for a map or plan that cannot be used, and a port that is taken.
    """
    session = RegistrationSession(
        folder, store.load(folder), load_plan(folder, plan, resolution_m), distances, seed
    )
    token = secrets.token_urlsafe(24)
    try:
        listener = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise MapError(f"127.0.0.1:{port}: {error.strerror or error}") from None

    def done() -> None:
        server.should_exit = True

    server = uvicorn.Server(
        uvicorn.Config(
            build(session, token, done),
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="off",
            timeout_graceful_shutdown=2,
        )
    )
    address = f"http://127.0.0.1:{listener.getsockname()[1]}/{token}/"
    print(f"the page: {address}\nit ends when the map is saved, or with Ctrl-C", flush=True)
    if browser and _has_display():
        webbrowser.open(address)
    try:
        with listener:
            server.run(sockets=[listener])
    except KeyboardInterrupt:
        pass
    return session.found


def _has_display() -> bool:
    shown = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    return shown or sys.platform in ("darwin", "win32")


def _refusal(status: int, detail: str) -> Response:
    return JSONResponse({"detail": " ".join(detail.split())}, status)


def _page(nonce: str) -> str:
    """The page with its style and script inside; what it shows comes as data, never as markup."""
    html = (_HERE / "page.html").read_text(encoding="utf-8")
    inside = {"/*style*/": "page.css", "/*view*/": "view.js", "/*script*/": "page.js"}
    for mark, file in inside.items():
        text = (_HERE / file).read_text(encoding="utf-8")
        html = html.replace(mark, text, 1)
    return html.replace("{nonce}", nonce)
