"""Pages that are made here: the log-in form and the API's description. No script, one style."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import parse_qs

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from ground_station.service.web.access import COOKIE, SESSION_S, Access, Refused

_CSS = """\
:root { color-scheme: light dark; background: Canvas; font: 16px/1.5 system-ui, sans-serif; }
body { max-width: 60rem; margin: 0 auto; padding: 2rem 1rem 4rem; }
form { max-width: 22rem; margin: 12vh auto 0; display: grid; gap: 0.75rem; }
input, button { font: inherit; padding: 0.6rem 0.75rem; border-radius: 0.4rem; border: 1px solid #8888; }
button { cursor: pointer; background: #0b62c4; color: #fff; border: 0; }
p.problem { margin: 0; color: light-dark(#b33c00, #ff8a4d); }
code, pre { font: 0.9em/1.45 ui-monospace, monospace; }
pre { padding: 0.75rem; overflow-x: auto; border: 1px solid #8884; border-radius: 0.4rem; }
section { border-top: 1px solid #8884; padding-top: 0.5rem; margin-top: 1.5rem; }
h2 code { font-size: 0.85em; }
h2 .method { color: #0b62c4; margin-right: 0.5em; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: 0.3rem 0.75rem 0.3rem 0; border-bottom: 1px solid #8883; }
"""  # noqa: E501


def _page(title: str, body: str) -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{html.escape(title)}</title><link rel="icon" href="data:,">'
        '<link rel="stylesheet" href="/page.css"></head>'
        f"<body><main>{body}</main></body></html>"
    )


def _login_page(
    station: str, problem: str = "", status: int = 200, retry_s: int | None = None
) -> Response:
    """The form. Under the policy of all other pages, no-referrer, it would be sent as of nobody.

    With it browsers give a form's request the Origin "null" (Fetch standard, section 3.2).
    """
    headers = {"referrer-policy": "same-origin"}
    if retry_s is not None:
        headers["retry-after"] = str(retry_s)
    said = f'<p class="problem" role="alert">{html.escape(problem)}</p>' if problem else ""
    page = _page(
        f"{station}: log in",
        '<form method="post" action="/login">'
        f"<h1>{html.escape(station)}</h1>{said}"
        '<label for="token">Token of this ground station</label>'
        '<input id="token" name="token" type="password" autocomplete="current-password"'
        " required autofocus><button>Log in</button></form>",
    )
    return HTMLResponse(page, status, headers)


def router(access: Access, station: str) -> APIRouter:
    """Log in, log out, and the style of both pages."""
    result = APIRouter(include_in_schema=False)

    @result.get("/page.css")
    def style() -> Response:
        return Response(_CSS, media_type="text/css")

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
        return HTMLResponse(_docs_page(app.openapi()))

    return result


def _docs_page(schema: Mapping[str, Any]) -> str:
    info = schema["info"]
    parts = [
        f"<h1>{html.escape(info['title'])} {html.escape(info['version'])}</h1>",
        *(f"<p>{html.escape(text)}</p>" for text in str(info["description"]).split("\n\n")),
        '<p>For programs: <a href="/api/openapi.json">/api/openapi.json</a></p>',
    ]
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            parts.append("".join(_operation(path, method, operation)))
    parts.append("<section><h2>Types</h2>")
    for name, model in schema.get("components", {}).get("schemas", {}).items():
        text = html.escape(json.dumps(model, indent=1))
        parts.append(
            f'<h3 id="{html.escape(name)}">{html.escape(name)}</h3><pre tabindex="0">{text}</pre>'
        )
    return _page(info["title"], "".join(parts) + "</section>")


def _operation(path: str, method: str, operation: Mapping[str, Any]) -> Iterator[str]:
    yield (
        f'<section><h2><span class="method">{method.upper()}</span>'
        f"<code>{html.escape(path)}</code></h2>"
        f"<p>{html.escape(str(operation.get('description', '')))}</p>"
    )
    if body := operation.get("requestBody"):
        yield f"<p>Takes {_types(body)}</p>"
    yield "<table><tr><th>Status</th><th>Answer</th><th>Meaning</th></tr>"
    for status, answer in operation.get("responses", {}).items():
        text = html.escape(str(answer.get("description", "")))
        cells = (html.escape(str(status)), _types(answer), text)
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    yield "</table></section>"


def _types(of: Mapping[str, Any]) -> str:
    """Media types, with a link to the model where there is one."""
    result = []
    for kind, content in of.get("content", {}).items():
        schema = content.get("schema", {})
        reference = schema.get("$ref") or schema.get("items", {}).get("$ref", "")
        name = html.escape(reference.rpartition("/")[2])
        many = "list of " if schema.get("type") == "array" else ""
        link = f' ({many}<a href="#{name}">{name}</a>)' if name else ""
        result.append(f"<code>{html.escape(kind)}</code>{link}")
    return ", ".join(result) or "nothing"
