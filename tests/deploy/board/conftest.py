from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import pytest
from board_cards import Person

from deploy.provisioning import wpa


@pytest.fixture
def person(tmp_path: Path) -> Person:
    return Person(tmp_path)


@pytest.fixture
def people(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Person]:
    """One card after another, each again; a password's key is reckoned once for all of them."""
    monkeypatch.setattr(wpa, "psk", functools.cache(wpa.psk))
    count = 0

    def make() -> Person:
        nonlocal count
        count += 1
        return Person(tmp_path / f"card-{count}")

    return make
