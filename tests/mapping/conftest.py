"""Fixtures of the tests of mapping."""

from built_scene import built, scene_settings, target, use_scene  # noqa: F401
from refining import _world, world  # noqa: F401
