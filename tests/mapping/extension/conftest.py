"""Fixtures of the tests of extending."""

from corridor_light import _corridor_world, corridor_world  # noqa: F401
