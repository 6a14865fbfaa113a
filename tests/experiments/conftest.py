"""Two rooms made by hand, whose landmarks look different."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from ground_station.map.store import Map

sys.path.insert(0, str(Path(__file__).parents[1] / "inspection"))  # for rooms_map


@pytest.fixture
def rooms() -> Map:
    from rooms_map import two_rooms

    map_ = two_rooms()
    rows = np.abs(np.random.default_rng(1).normal(size=(len(map_.landmarks), 32)))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    map_.landmarks.descriptor = rows.astype(np.float32)
    map_.info.dimension = 32
    return map_
