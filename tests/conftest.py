"""For all tests: a change is judged by the same examples each time it is checked (CI is set).

`make test` runs the tests marked `beside` on all cores at once, then those that fly two at a time,
and those marked `alone`, which measure or need the machine, one by one.
"""

import contextlib
import ctypes
import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import browser, launch  # noqa: F401 - fixtures
from hypothesis import settings

# As every program sets it: BLAS's own threads would spin against those of the tests beside them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).with_name("stream")))  # for `receiving`, which many rooms need
sys.path.append(str(Path(__file__).with_name("i2c")))  # for `simulated_gauges`
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")

# GStreamer brings libunwind into the process, by which a C++ exception of matplotlib's ends it
# with a segmentation fault, unless libgcc's own functions of these names were there before. No
# program of ours loads both; tests of both may come into one process.
with contextlib.suppress(OSError):
    ctypes.CDLL("libgcc_s.so.1", mode=ctypes.RTLD_GLOBAL)

_ROOMS = {
    "bench", "calibration", "cli", "commands", "deploy", "evaluation", "experiments",
    "feature_models", "features", "fuzz", "geometry", "hw", "inspection", "localization", "map",
    "map_update", "mapping", "maps", "recording", "simulator", "training", "wire",
}  # fmt: skip
"""Rooms in whose tests nothing flies: no program that another one disturbs by using a core."""


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_disks() -> Iterator[None]:
    """Power is cut in play only: that something is synced counts, a disk takes 7 ms for each."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fsync", "fdatasync", "sync"):
            patch.setattr(os, name, lambda *_: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _cache_of_their_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test finds, or leaves, anything in the cache of the person who runs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BLIMP_CACHE", str(tmp_path_factory.mktemp("blimp-cache")))
        yield


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Whether a phase of `make test` would leave a folder or file out whole: reading is slow."""
    phase = config.getoption("markexpr")
    if phase == "alone" and collection_path.suffix == ".py":
        return "mark.alone" not in collection_path.read_text() or None
    if phase in ("beside", "not beside and not alone"):
        room, *within = (*collection_path.relative_to(Path(__file__).parent).parts, "")
        if any(within):
            return (room in _ROOMS) != (phase == "beside") or None
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what may run beside other tests, all of these rooms but what measures.

    Files of few tests come first: they are the long ones, which no worker shall begin last.
    """
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: (tests[item.path], item.path))
    here = Path(__file__).parent
    for item in items:
        room = item.path.relative_to(here).parts[0]
        if room in _ROOMS and item.get_closest_marker("alone") is None:
            item.add_marker("beside")
