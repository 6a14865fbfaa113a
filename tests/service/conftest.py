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

from ground_station.service.bus import Router
from ground_station.service.web.access import Buckets

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


@pytest.fixture
def bus_folder(tmp_path: Path) -> Iterator[Path]:
    """A run's folder with its bus."""
    with contextlib.closing(Router(tmp_path)):
        yield tmp_path


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Any, Any, Any]]:
    with station.application(tmp_path) as parts:
        yield parts


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any, Any]]:
    """The same, one for all tests of a file that change nothing in it."""
    with station.application(tmp_path_factory.mktemp("unchanged")) as parts:
        parts[2].access.posts = Buckets(1e9, 10**9)  # many tests together may ask more often
        yield parts
