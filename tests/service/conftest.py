"""A headless browser, without which tests of pages are skipped; the application on a silent bus."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import web_station as station

from ground_station.service.web.app import build

sys.path.append(str(Path(__file__).parents[1] / "evaluation"))  # for parsed_page

HERE = "http://127.0.0.1:8080"
_NAMES = ("chromium", "chromium-browser", "google-chrome")
_ARGUMENTS = (
    "--no-sandbox",  # tests run as root in containers
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Without a GPU all but WebGL is faster when it does not pretend to have one.
    "--disable-gpu-compositing",
    "--disable-accelerated-2d-canvas",
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium as the system has it.

    Once a module and not a session: while Playwright runs, its thread has an event loop, and
    `asyncio.run` in others' tests would be refused.
    """
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    path = next((found for name in _NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(_NAMES)} is installed")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=list(_ARGUMENTS))
        yield started
        started.close()


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
