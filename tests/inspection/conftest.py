"""Fixtures of the tests of mapping, for maps that are built here, too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "mapping"))
from built_scene import built, scene_settings, use_scene  # noqa: F401
