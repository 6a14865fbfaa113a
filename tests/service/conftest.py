"""The application on a silent bus, and tests that are coroutines."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import web_station as station

from ground_station.service.web.access import Buckets
from ground_station.service.web.app import build

HERE = "http://127.0.0.1:8080"
ASYNC_LIMIT_S = 60.0


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """A test that is a coroutine is run to its end, within a minute."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {
        name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters
    }
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**given), ASYNC_LIMIT_S))
    return True


@contextlib.contextmanager
def application(folder: Path) -> Iterator[tuple[Any, Any, Any]]:
    """A client of the application, the bus that it hears, and what its process drives."""
    bus = station.SilentBus()
    web = build(station.run_of(folder), folder, bus, None)
    client = station.TestClient(
        web.guarded, HERE, follow_redirects=False, raise_server_exceptions=False
    )
    with client:
        station.say_all(bus.put)
        yield client, bus, web


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Any, Any, Any]]:
    with application(tmp_path) as parts:
        yield parts


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any, Any]]:
    """The same, one for all tests of a file that change nothing in it."""
    with application(tmp_path_factory.mktemp("unchanged")) as parts:
        parts[2].access.posts = Buckets(1e9, 10**9)  # many tests together may ask more often
        yield parts
