"""Cuts the power after so many changes of the file system: what follows reaches no card."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import pytest

_CHANGES = ("replace", "rename", "unlink", "rmdir", "mkdir", "symlink", "fsync", "sync", "open")


class PowerCut(BaseException):
    """The board is off: no `except Exception` and no clean-up sees it."""


class Supply:
    """Counts changes; `left` of them are still done."""

    def __init__(self, left: int) -> None:
        self.left, self.changes = left, 0

    def spend(self) -> None:
        if self.changes >= self.left:
            raise PowerCut
        self.changes += 1


@contextlib.contextmanager
def cut_after(changes: int) -> Iterator[Supply]:
    """Lets so many changes happen; then each one raises `PowerCut`, the clean-up's, too."""
    supply = Supply(changes)
    with pytest.MonkeyPatch.context() as patch:
        for name in _CHANGES:
            patch.setattr(os, name, _counted(getattr(os, name), supply, name == "open"))
        yield supply


def _counted(real: Any, supply: Supply, reads: bool) -> Any:
    def call(*arguments: Any, **named: Any) -> Any:
        flags = arguments[1] if reads and len(arguments) > 1 else 0
        if not reads or flags & (os.O_CREAT | os.O_WRONLY | os.O_RDWR):
            supply.spend()
        return real(*arguments, **named)

    return call
