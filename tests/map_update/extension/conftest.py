"""Fixtures of the tests of extending."""

from corridor_light import (  # noqa: F401
    _corridor_world,
    by_sunset,
    corridor_world,
    short_flight,
)
