"""`ground_station.service.web.live` and `.viewer`: what a viewer says over its WebSocket."""

from __future__ import annotations

import asyncio

from pieces import Picker, as_json, changed, stretch

from ground_station.service.web import viewer as viewers
from readers import asgi

_WEB = asgi.application()
_LOOP = asyncio.new_event_loop()
_MESSAGES = (
    {"type": "select", "payload": "blimp-1"},
    {"type": "video", "on": True},
    {"type": "shown", "shown_ms": 12.5},
    {"type": "ping", "sent_ms": 5},
)


def fuzz(data: bytes) -> None:
    """A message is obeyed, or the viewer is told in one line why it is sent away."""
    _LOOP.run_until_complete(_hear(Picker(data)))
    _WEB.metrics.text()


async def _hear(picker: Picker) -> None:
    viewer = viewers.Viewer("blimp-1")
    for _ in range(50):
        if not picker.left():
            break
        message = picker.of(_MESSAGES)
        if picker.number(1) % 4 == 3:
            text = picker.rest().decode("utf-8", errors="surrogateescape")
        else:
            text = as_json(changed(picker, message)).decode()
        try:
            _WEB.live._heard(viewer, viewers.parse(text))
        except viewers.Broken as error:
            reason = str(error)
            # A close frame's reason has 123 bytes at most (RFC 6455, 5.5).
            assert len(reason.encode()) <= 123 and len(reason.splitlines()) == 1


def seeds() -> list[bytes]:
    """One of each."""
    return [
        *(bytes([number, 0, 0, 0, 0]) for number in range(len(_MESSAGES))),
        b'\0\3{"type":"ping","sent_ms":1e999}',
        b'\0\3{"type":"shown","shown_ms":-0}',
        b'\0\3{"type":"select","payload":"\\ud800"}',
        stretch((1, b"\0\3"), (2000, b"[")),
        stretch((1, b'\0\3{"type":"ping","sent_ms":'), (1900, b"9"), (1, b"}")),
    ]
