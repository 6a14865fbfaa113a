"""What the station that runs answers over HTTP, for commands on its own machine."""

from __future__ import annotations

import http.client
import json
import urllib.request
from typing import Any

from ground_station.service.settings import HttpSettings

_TIMEOUT_S = 3.0
_ANSWER_BYTES = 1 << 20


def ask(settings: HttpSettings, path: str, token: str | None = None) -> Any:
    """What it says at a path, as JSON; raises `OSError` or `ValueError` where nothing does."""
    place = f"[{settings.host}]" if ":" in settings.host else settings.host
    request = urllib.request.Request(f"http://{place}:{settings.port}{path}")
    if token:
        request.add_header("Authorization", f"Bearer {token}")
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with direct.open(request, timeout=_TIMEOUT_S) as answer:
            return json.loads(answer.read(_ANSWER_BYTES))
    except http.client.HTTPException as error:  # who is there speaks another protocol
        raise ValueError(f"{path}: {error!r}") from None
