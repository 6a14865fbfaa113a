"""Recorded flights for the tests of the stream."""

from pathlib import Path

import pytest
from numbered_flight import write_flight


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 60 frames, 2 s, none of them dark."""
    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", 60)
