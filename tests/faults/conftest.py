"""What faults befall: a numbered flight."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "stream"))  # for numbered_flight


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A numbered flight to fly in a loop."""
    from flight import ROUND
    from numbered_flight import write_flight

    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", ROUND)
