"""A build that was killed goes on where it was: the same map, and nothing made twice."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hand_made import content

from ground_station.geometry.alignment import align
from ground_station.map import store
from ground_station.mapping.construction import build, work
from ground_station.mapping.construction.cache import Cache
from ground_station.mapping.construction.workers import under_way

SCRIPT = Path(__file__).with_name("killed_build.py")
THREADS = 2


def _killed(tmp_path, step, count):
    """Starts the build and has it killed; the calls of all builds so far."""
    paths = [tmp_path / name for name in ("map", "cache", "calls")]
    process = subprocess.run(
        [sys.executable, SCRIPT, *paths, step, str(count)], capture_output=True, timeout=120
    )
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()[-500:]
    return Counter((tmp_path / "calls").read_text().split())


def test_a_build_killed_again_and_again_gives_the_same_map_and_does_nothing_twice(
    built, target, use_scene, tmp_path
):
    """Until it is there, the old map is, whole."""
    images = len(built.scene.wTc)
    pairs = images * (images - 1) // 2
    lost = under_way(THREADS)  # what threads had in hand when they were killed
    calls = _killed(tmp_path, "verify", 40)
    assert calls == {"extract": images, "verify": 40}
    calls = _killed(tmp_path, "sfm", 6)
    assert pairs <= calls["verify"] <= pairs + lost and calls["extract"] == images
    (folder,) = (tmp_path / "cache" / "work").iterdir()
    compared = calls["verify"]
    calls = _killed(tmp_path, "save", 1)
    assert (calls["extract"], calls["verify"]) == (images, compared)
    assert list((tmp_path / "cache" / "work").iterdir()) == [folder]
    assert content(target) == content(built.folder)

    use_scene(built.scene)
    with Cache(tmp_path / "cache") as cache:
        map_ = build.build_map(
            built.scene.frames(), built.scene.camera, built.settings, tmp_path / "map", cache=cache
        )
    assert store.load_info(tmp_path / "map").built["cache"] == {
        "features_found": images, "features_made": 0, "pairs_found": pairs, "pairs_made": 0,
        "damaged": 0,
    }  # fmt: skip
    assert not list((tmp_path / "cache" / "work").iterdir())
    assert map_.keyframes.names == built.map.keyframes.names
    truth = built.scene.wTc[:, :3, 3]
    metres = align(built.map.keyframes.wTc[:, :3, 3], truth, True)
    before = metres.apply(built.map.keyframes.wTc[:, :3, 3])
    after = align(map_.keyframes.wTc[:, :3, 3], before, True).apply(map_.keyframes.wTc[:, :3, 3])
    assert np.linalg.norm(after - before, axis=1).max() < 1e-3


def test_a_folder_for_work_stays_after_a_failure_and_goes_with_success(tmp_path):
    with pytest.raises(RuntimeError), work.lasting(tmp_path / "work", "one") as folder:
        (folder / "snapshot").write_text("half")
        raise RuntimeError
    with work.lasting(tmp_path / "work", "one") as folder:
        assert (folder / "snapshot").read_text() == "half"
        # Another build of the same at the same time does its work elsewhere.
        with work.lasting(tmp_path / "work", "one") as taken:
            assert taken is None
        assert (folder / "snapshot").exists()
    assert not list((tmp_path / "work").iterdir())
    (tmp_path / "file").write_text("x")
    with work.lasting(tmp_path / "file", "one") as folder:
        assert folder is None


def test_old_work_is_pruned_unless_a_build_has_it(tmp_path):
    for n in range(8):
        with pytest.raises(RuntimeError), work.lasting(tmp_path, f"work-{n}"):
            raise RuntimeError
    left = {path.name for path in tmp_path.iterdir()}
    assert len(left) <= work._MOST_KEPT + 1 and {"work-7", "work-6"} <= left
    with work.lasting(tmp_path, "held") as held:
        for n in range(8):
            with pytest.raises(RuntimeError), work.lasting(tmp_path, f"more-{n}"):
                raise RuntimeError
        assert held.is_dir()
