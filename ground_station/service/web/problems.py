"""Errors of the HTTP API: always {"detail": one line}, never a traceback."""

from __future__ import annotations

import sys
import traceback
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from ground_station.errors import GroundStationError
from ground_station.service.web.models import Problem
from pi_firmware.wire.errors import BlimpError

_TEXT = {
    400: "The body is no JSON.",
    401: "A token is needed, or the one given is wrong.",
    403: "The Host or Origin is another's.",
    404: "There is none of that name.",
    405: "Another method is needed.",
    409: "It is there but cannot be used; `detail` says why.",
    413: "The body is too large.",
    416: "The file has no such range.",
    422: "A value is not as described here.",
    429: "Too many at once; `Retry-After` says how long to wait.",
}


class NotFound(GroundStationError):
    """Something that is asked for by a name that is not there."""


class Busy(GroundStationError):
    """Too much is asked for at once."""


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """These statuses as an operation's `responses`."""
    return {status: {"model": Problem, "description": _TEXT[status]} for status in statuses}


EVERYWHERE = problems(400, 401, 403, 422, 429)


def install(app: FastAPI) -> None:
    """Gives an application its error answers."""

    def answer(status: int, detail: str, headers: dict[str, str] | None = None) -> JSONResponse:
        return JSONResponse({"detail": detail}, status, headers=headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        return answer(422, _first(error))

    @app.exception_handler(HTTPException)
    async def http(_: Request, error: HTTPException) -> JSONResponse:
        return answer(error.status_code, str(error.detail), dict(error.headers or {}))

    @app.exception_handler(BlimpError)
    async def refused(_: Request, error: BlimpError) -> JSONResponse:
        if isinstance(error, NotFound):
            return answer(404, str(error))
        if isinstance(error, Busy):
            return answer(429, str(error), {"retry-after": "2"})
        return answer(409, str(error))

    @app.exception_handler(Exception)
    async def failed(request: Request, error: Exception) -> JSONResponse:
        print(f"web: {request.method} {request.url.path[:200]!r} failed", file=sys.stderr)
        traceback.print_exception(error, file=sys.stderr)
        return answer(500, "the station failed at this; its log says more")


def _first(error: RequestValidationError) -> str:
    """The first thing that is wrong: where, and what."""
    found = error.errors()[0]
    where = ".".join(str(part)[:40] for part in found.get("loc", ()))
    return f"{where}: {str(found.get('msg', 'invalid'))[:200]}"
