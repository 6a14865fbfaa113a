"""An authority with one ground station and one payload."""

from pathlib import Path

import pytest

from ground_station.keys.authority import Authority


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    made = Authority.create(tmp_path / "keys")
    made.add("ground", "main")
    made.add("payload", "blimp-1")
    return made
