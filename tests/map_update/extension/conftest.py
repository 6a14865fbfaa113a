"""Fixtures of the tests of extending."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "mapping"))  # for hand_made
from corridor_light import (  # noqa: F401
    _corridor_world,
    by_sunset,
    corridor_world,
    short_flight,
)
