from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from board_cards import Person


@pytest.fixture
def person(tmp_path: Path) -> Person:
    return Person(tmp_path)


@pytest.fixture
def people(tmp_path: Path) -> Callable[[], Person]:
    """One card after another, each again."""
    count = 0

    def make() -> Person:
        nonlocal count
        count += 1
        return Person(tmp_path / f"card-{count}")

    return make
