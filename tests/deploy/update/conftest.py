"""A card in a folder, for the tests of updates."""

import shutil
import sys
from pathlib import Path

import pytest
from card_stand import Card, make_key

sys.path.append(str(Path(__file__).parents[1] / "image"))  # for card_parts


@pytest.fixture(scope="session")
def release_key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("ssh-keygen") is None:
        pytest.skip("no ssh-keygen here (openssh-client)")
    return make_key(tmp_path_factory.mktemp("keys") / "releases")


@pytest.fixture
def card(tmp_path: Path, release_key: Path) -> Card:
    return Card(tmp_path / "card", release_key)
