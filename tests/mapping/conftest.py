"""Fixtures of the tests of mapping."""

import shutil

import pytest
from built_scene import built, scene_settings, use_scene  # noqa: F401
from refining import _world, world  # noqa: F401


@pytest.fixture
def target(built, tmp_path):  # noqa: F811
    """A copy of the built map."""
    return shutil.copytree(built.folder, tmp_path / "map")
