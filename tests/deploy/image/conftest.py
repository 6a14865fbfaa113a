"""What the cards of these tests are built from."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from card_parts import make_checkout

from tests.deploy.image.local_archive import TOOLS, Key, need_tools, new_key


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A git repository with what a card takes of this one; a test may add what is not tracked."""
    return make_checkout(tmp_path_factory.mktemp("checkout"))


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Key, Key]]:
    """Two keys that archives are signed with."""
    need_tools(*TOOLS)
    folder = tmp_path_factory.mktemp("keys")
    with new_key(folder, "one") as one, new_key(folder, "other") as other:
        yield one, other
