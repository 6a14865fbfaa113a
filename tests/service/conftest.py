"""The application on a silent bus."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import web_station as station

from ground_station.service.web.app import build

HERE = "http://127.0.0.1:8080"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Any, Any, Any]]:
    """A client of the application, the bus that it hears, and what its process drives."""
    bus = station.SilentBus()
    web = build(station.run_of(tmp_path), tmp_path, bus, None)
    client = station.TestClient(
        web.guarded, HERE, follow_redirects=False, raise_server_exceptions=False
    )
    with client:
        station.say_all(bus.put)
        yield client, bus, web
