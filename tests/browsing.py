"""The system's Chromium, headless, for tests of pages; without one they are skipped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = (
    "--no-sandbox",  # tests run as root in containers
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Without a GPU all but WebGL is faster when it does not pretend to have one.
    "--disable-gpu-compositing",
    "--disable-accelerated-2d-canvas",
)


@pytest.fixture(scope="module")
def launch() -> Iterator[Any]:
    """Starts it with further arguments, as often as it is called.

    Once a module and not a session: while Playwright runs, its thread has an event loop, and
    `asyncio.run` in others' tests would be refused.
    """
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    path = next((found for name in _NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(_NAMES)} is installed")
    started: list[Any] = []
    with sync_api.sync_playwright() as playwright:

        def start(*further: str) -> Any:
            arguments = [*ARGUMENTS, *further]
            started.append(playwright.chromium.launch(executable_path=path, args=arguments))
            return started[-1]

        yield start
        for browser in started:
            browser.close()


@pytest.fixture(scope="module")
def browser(launch: Any) -> Any:
    """One that is started."""
    return launch()
