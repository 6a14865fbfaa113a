"""`ground_station.service.web`: the dashboard's HTTP API."""

from __future__ import annotations

import asyncio
import json
from typing import Any
from urllib.parse import quote_from_bytes

from pieces import Picker, as_json, blocks, changed, stretch

from readers import asgi

_WEB = asgi.application()
_LOOP = asyncio.new_event_loop()
_POSTS = (
    (b"/api/payloads/blimp-1/command", {"name": "bitrate", "arguments": {"kbps": 800}}),
    (b"/api/payloads/blimp-1/map", {"name": "atrium"}),
    (b"/api/recording", {"active": True}),
    (b"/api/payloads/blimp-1/relocalize", {}),
    (b"/login", {"token": "x"}),
    (b"/logout", {}),
)
_GETS = (
    b"/api/state", b"/api/maps", b"/api/maps/%s", b"/api/maps/%s/floorplan.png", b"/metrics",
    b"/api/maps/%s/landmarks", b"/api/recordings/%s", b"/api/recordings/%s?%s", b"/static/%s",
    b"/%s", b"/api/openapi.json", b"/login?next=%s",
)  # fmt: skip
_KINDS = (b"application/json", b"application/x-www-form-urlencoded", b"text/plain", b"")


def fuzz(data: bytes) -> None:
    """Nothing is answered by a 5xx, and nothing raises."""
    picker = Picker(data)
    how = picker.number(1)
    headers = [(b"content-type", picker.of(_KINDS))]
    if how & 2:
        headers.append((picker.bytes(picker.number(1) % 20).lower(), picker.block()))
    if how & 4:
        headers.append((b"origin", b"http://127.0.0.1:%d" % asgi.PORT))
    if how & 1:
        target, document = picker.of(_POSTS)
        raw = picker.number(1) % 4 == 3
        body = picker.rest() if raw else as_json(changed(picker, document))
        headers.append((b"content-length", b"%d" % len(body)))
        _ask("POST", target, headers, body)
    else:
        target = picker.of(_GETS)
        for _ in range(target.count(b"%s")):
            piece = picker.block()
            quoted = quote_from_bytes(piece, safe="").encode() if picker.number(1) % 2 else piece
            target = target.replace(b"%s", quoted, 1)
        method = picker.of(("GET", "GET", "HEAD", "OPTIONS", "DELETE", "PUT"))
        _ask(method, target, headers, b"")


def _ask(method: str, target: bytes, headers: list[Any], body: bytes) -> None:
    status = _LOOP.run_until_complete(asgi.ask(_WEB, method, target, headers, body))
    assert 200 <= status < 500, (status, method, target)


def seeds() -> list[bytes]:
    """Each address as it is meant; bodies that are none."""
    posts = [bytes([5, 0, number, 0]) for number in range(len(_POSTS))]
    gets = [bytes([4, 0, number]) + blocks(b"atrium") + b"\1" for number in range(len(_GETS))]
    deep = [stretch((1, b"\5\0\0\3"), (n, b"["), (n, b"]")) for n in (500, 5000)]
    inside = json.dumps({"name": "bitrate", "arguments": {"kbps": 10**400}}).encode()
    return [
        *posts,
        *gets,
        *deep,
        b"\5\0\0\3" + inside,
        b'\5\0\0\3{"name":"bitrate","arguments":{"kbps":1e999}}',
        b'\5\0\0\3{"name":"bitrate","arguments":{"\\ud800":NaN}}',
        b"\5\1\4\3token=%ff%00&token=",
        b"\4\0\6" + blocks(b"../../../etc/passwd") + b"\1",
        b"\6\0\5range" + blocks(b"bytes=0-1,2-3,-9") + b"\6" + blocks(b"a.mcap") + b"\0",
    ]
