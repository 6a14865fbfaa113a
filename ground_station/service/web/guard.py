"""The gate before the application: access rules, bounds on bodies, and headers on every answer."""

from __future__ import annotations

import asyncio

from prometheus_client import Counter
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from ground_station.service.web.access import Access, Refused, cookie_of

BODY_BYTES = 64 * 1024
_BODY_S = 10.0
_SAFE = ("GET", "HEAD", "OPTIONS")
OPEN_PATHS = ("/login", "/page.css", "/healthz")
"""What is answered without a token."""

HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self';"
    " object-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """ASGI middleware around the whole application.

    What gets in finds its way of access in `scope["state"]`: `by` and `session`. Answers are
    counted in `answers` by method and status class.
    """

    def __init__(self, app: ASGIApp, access: Access, answers: Counter) -> None:
        self._app, self._access, self._answers = app, access, answers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        method = "WS" if scope["type"] == "websocket" else str(scope["method"])
        answer = _Answer(scope, send)
        try:
            self._check(scope, method)
            if method not in (*_SAFE, "WS"):
                receive = await _whole_body(scope, receive)
            await self._app(scope, receive, answer.send)
        except Refused as refused:
            if answer.begun:
                raise
            await self._refuse(scope, receive, refused, answer)
        finally:
            known = method if method in (*_SAFE, "POST", "DELETE", "WS") else "other"
            self._answers.labels(known, answer.status_class).inc()

    def _check(self, scope: Scope, method: str) -> None:
        headers = Headers(scope=scope)
        address = (scope.get("client") or ("", 0))[0]
        self._access.check_host(headers, (scope.get("server") or ("", 0))[0])
        path = scope["path"]
        by = "open" if path in OPEN_PATHS else self._access.authenticate(headers, address)
        if path.startswith(("/api/", "/metrics")):
            self._access.check_site(headers)
        if method not in _SAFE:
            self._access.check_origin(headers, by)
        if method not in (*_SAFE, "WS"):
            self._access.check_rate(address)
        scope.setdefault("state", {}).update(by=by, session=cookie_of(headers))

    async def _refuse(
        self, scope: Scope, receive: Receive, refused: Refused, answer: _Answer
    ) -> None:
        is_http = scope["type"] == "http"
        if not is_http and "websocket.http.response" not in scope.get("extensions", {}):
            await WebSocketClose(1008)(scope, receive, answer.send)
            return
        headers = {} if refused.retry_s is None else {"retry-after": str(refused.retry_s)}
        response: Response = JSONResponse({"detail": refused.detail}, refused.status, headers)
        if refused.status == 401:
            response.headers["www-authenticate"] = "Bearer"
            if is_http and scope["method"] == "GET" and scope["path"] == "/":
                response = RedirectResponse("/login", 303)
        if is_http:
            response.headers["connection"] = "close"  # a body may still be on its way
        await response(scope, receive, answer.send)


class _Answer:
    """Adds the headers to what is sent, and keeps the status."""

    def __init__(self, scope: Scope, send: Send) -> None:
        self._send = send
        self._path = str(scope["path"])
        self.begun = False
        self.status_class = "none"

    async def send(self, message: Message) -> None:
        kind = message["type"]
        if kind in ("http.response.start", "websocket.http.response.start"):
            self.begun = True
            self.status_class = f"{message['status'] // 100}xx"
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            # Nothing old is shown; what has an ETag is asked for again, not sent again.
            cache = "no-cache" if "etag" in headers else "no-store"
            headers.setdefault("cache-control", cache)
        elif kind == "websocket.accept":
            self.begun, self.status_class = True, "1xx"
        await self._send(message)


async def _whole_body(scope: Scope, receive: Receive) -> Receive:
    """Reads a body to its end, within size and time; returns what gives it once more."""
    length = Headers(scope=scope).get("content-length", "0")
    if not length.isdecimal() or int(length) > BODY_BYTES:
        raise Refused(413, f"the body has {length[:20]} bytes; at most {BODY_BYTES}")
    body = bytearray()
    try:
        async with asyncio.timeout(_BODY_S):
            async for piece in Request(scope, receive).stream():
                body += piece
                if len(body) > BODY_BYTES:
                    raise Refused(413, f"the body has more than {BODY_BYTES} bytes")
    except ClientDisconnect:
        pass  # there is nobody to answer
    except TimeoutError:
        raise Refused(408, f"the body did not come within {_BODY_S:.0f} s") from None
    given = False

    async def again() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": bytes(body), "more_body": False}

    return again
