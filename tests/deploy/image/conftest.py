"""What the cards of these tests are built from."""

from pathlib import Path

import pytest
from card_parts import make_checkout


@pytest.fixture(scope="session")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A git repository with what a card takes of this one; a test may add what is not tracked."""
    return make_checkout(tmp_path_factory.mktemp("checkout"))
