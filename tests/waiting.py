"""Waiting for what other threads and processes do, with a limit and never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


def eventually(
    condition: Callable[[], Any],
    limit_s: float = 120.0,
    *,
    what: str = "it",
    step: Callable[[], object] = lambda: None,
) -> Any:
    """What the condition gives as soon as that is true; fails when it takes absurdly long.

    `what` is said then; `step` is done before each further look.
    """
    until_s = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < until_s, f"{what} did not come"
        step()
        time.sleep(0.01)
    return found
