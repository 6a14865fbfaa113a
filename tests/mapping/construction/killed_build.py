"""Not a test: builds the map of the tests' scene and kills itself at a given moment of it.

    python killed_build.py OUT CACHE CALLS extract|verify|sfm|save COUNT

CALLS gets one line for each image that is extracted, each pair that is compared, each image that
structure from motion registers, and for the map's tables; at the COUNT-th of its kind the process
sends itself SIGKILL, in the middle of whatever its threads do.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from built_scene import SceneExtractor, make_scene

from ground_station.features import extractors
from ground_station.map import store
from ground_station.mapping.construction import build, cache, verification
from ground_station.mapping.settings import MappingSettings
from ground_station.progress import Progress


class Counter:
    """Notes calls in a file that outlives the process, and ends it at one of them."""

    def __init__(self, path, step, count):
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._step, self._left = step, count
        self._lock = threading.Lock()

    def __call__(self, step):
        with self._lock:
            os.write(self._file, f"{step}\n".encode())
            self._left -= step == self._step
            if step == self._step and not self._left:
                os.kill(os.getpid(), signal.SIGKILL)

    def around(self, step, function):
        def call(*args, **kwargs):
            self(step)
            return function(*args, **kwargs)

        return call


def main(out, folder, calls, step, count):
    note = Counter(calls, step, int(count))
    scene = make_scene()
    extractor = SceneExtractor(scene)
    extractor.extract = note.around("extract", extractor.extract)
    extractors.METHODS["scene"] = lambda _: extractor
    verification.verify = note.around("verify", verification.verify)
    store.save_tables = note.around("save", store.save_tables)
    stepped = Progress.step

    def progressed(self, *args, **kwargs):
        if self._label.startswith("structure"):
            note("sfm")
        stepped(self, *args, **kwargs)

    Progress.step = progressed
    cache._COMMIT_S = 0.0  # what is lost is then what was under way, to the entry
    settings = MappingSettings(features="scene", threads=2)
    with cache.Cache(folder) as kept:
        build.build_map(scene.frames(), scene.camera, settings, out, cache=kept)


if __name__ == "__main__":
    main(*sys.argv[1:])
