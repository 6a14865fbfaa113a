"""For all tests: a change is judged by the same examples each time it is checked (CI is set)."""

import os

from hypothesis import settings

settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")
