"""Pages that are made here: the log-in form and the API's description. No script, one style."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse

from ground_station.service.web.access import COOKIE, SESSION_S, Access, Refused

if TYPE_CHECKING:
    import jinja2

_TEMPLATES = Path(__file__).with_name("templates")


@functools.cache
def _environment() -> jinja2.Environment:
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES), autoescape=True, trim_blocks=True
    )
    made.filters["as_json"] = functools.partial(json.dumps, indent=1)
    return made


def _page(
    template: str, status: int = 200, headers: Mapping[str, str] | None = None, **values: object
) -> Response:
    text = _environment().get_template(template).render(**values)
    return HTMLResponse(text, status, headers)


def _login_page(
    station: str, problem: str = "", status: int = 200, retry_s: int | None = None
) -> Response:
    """The form. Under the policy of all other pages, no-referrer, it would be sent as of nobody.

    With it browsers give a form's request the Origin "null" (Fetch standard, section 3.2).
    """
    headers = {"referrer-policy": "same-origin"}
    if retry_s is not None:
        headers["retry-after"] = str(retry_s)
    title = f"{station}: log in"
    return _page("login.html", status, headers, title=title, station=station, problem=problem)


def router(access: Access, station: str) -> APIRouter:
    """Log in, log out, and the style of both pages."""
    result = APIRouter(include_in_schema=False)

    @result.get("/page.css")
    def style() -> Response:
        return FileResponse(_TEMPLATES / "page.css", media_type="text/css")

    @result.get("/login")
    def form() -> Response:
        if not access.needs_token:
            return RedirectResponse("/", 303)
        return _login_page(station)

    @result.post("/login")
    async def log_in(request: Request) -> Response:
        if not access.needs_token:
            return RedirectResponse("/", 303)
        try:
            fields = parse_qs((await request.body()).decode(), max_num_fields=8)
            token = fields.get("token", [""])[0]
            access.check_token(request.client.host if request.client else "", token)
        except Refused as refused:
            return _login_page(station, refused.detail, refused.status, refused.retry_s)
        except ValueError:
            return _login_page(station, "not a form", 422)
        answer = RedirectResponse("/", 303)
        answer.set_cookie(
            COOKIE,
            access.sessions.begin(),
            max_age=SESSION_S,
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return answer

    @result.post("/logout")
    def log_out(request: Request) -> Response:
        access.sessions.end(str(request.scope["state"].get("session")))
        answer = RedirectResponse("/login", 303)
        answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
        return answer

    return result


def docs_router(app: FastAPI) -> APIRouter:
    """The API's description for people, from its OpenAPI document."""
    result = APIRouter(include_in_schema=False)

    @result.get("/api/docs")
    def docs() -> Response:
        schema = app.openapi()
        return _page("docs.html", title=schema["info"]["title"], **schema)

    return result
