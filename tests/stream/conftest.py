"""Recorded flights for the tests of the stream."""

import sys
from pathlib import Path

import pytest
from numbered_flight import write_flight

sys.path.insert(0, str(Path(__file__).parents[1] / "faults"))  # for impaired_link


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 60 frames, 2 s, none of them dark."""
    return write_flight(tmp_path_factory.mktemp("flight") / "flight.mcap", 60)
