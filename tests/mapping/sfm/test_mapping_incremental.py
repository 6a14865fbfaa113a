"""Structure from motion that was killed goes on from its last batch, to the same end."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import corridor_geometry as geometry
import numpy as np
import pytest
import two_images

from ground_station.errors import MapError
from ground_station.map import colmap
from ground_station.map.model import Model
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.incremental import Incremental, Wanted
from ground_station.mapping.sfm.snapshots import Snapshots

TESTS = Path(__file__).parents[1]
FRAMES = 36

_RUN = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import corridor_geometry as geometry
from ground_station.mapping.sfm.incremental import Incremental, Wanted

work, last = Path(sys.argv[2]), int(sys.argv[3])
seen = []
def on_image():
    seen.append(1)
    if len(seen) == last:
        os.kill(os.getpid(), signal.SIGKILL)
Incremental(work / "database.db", work, Wanted(0, 1, 1.5, int(sys.argv[4])), on_image).run()
"""


@pytest.fixture(scope="module")
def database(tmp_path_factory) -> Path:
    corridor = geometry.make_corridor(frames=FRAMES, bays=3, own=110, alike=0)
    path = tmp_path_factory.mktemp("database") / "database.db"
    images = corridor.images
    write_database(path, corridor.camera, images.names, images.pinhole_px, corridor.pairs)
    assert [entry.name for entry in path.parent.iterdir()] == ["database.db"]
    return path


def _run(database: Path, work: Path, counted: list[int] | None = None) -> Model:
    steps: list[int] = [] if counted is None else counted
    wanted = Wanted(0, 1, 1.5, FRAMES)
    (model,) = Incremental(database, work, wanted, lambda: steps.append(1)).run()
    return colmap.to_arrays(model)


@pytest.fixture(scope="module")
def whole(database, tmp_path_factory) -> Model:
    return _run(database, tmp_path_factory.mktemp("whole"))


def _kill(database: Path, work: Path, last: int) -> None:
    """A run in a process of its own that is killed at the image of that number."""
    work.mkdir(exist_ok=True)
    shutil.copy(database, work / "database.db")
    killed = subprocess.run(
        [sys.executable, "-c", _RUN, str(TESTS), str(work), str(last), str(FRAMES)],
        cwd=Path(__file__).parents[3], timeout=120, check=False,
    )  # fmt: skip
    assert killed.returncode == -signal.SIGKILL


@pytest.fixture(scope="module")
def killed(database, tmp_path_factory) -> Path:
    """The folder of a run that was killed at its 27th image; tests work on copies."""
    work = tmp_path_factory.mktemp("killed")
    _kill(database, work, 27)
    return work


@pytest.fixture
def left(killed, tmp_path) -> Path:
    """What a killed run left."""
    return Path(shutil.copytree(killed, tmp_path / "work"))


def _same(one: Model, other: Model) -> None:
    assert one.names == other.names
    assert np.abs(one.wTc - other.wTc).max() < 1e-6
    assert len(one.point_id) == len(other.point_id)


def test_a_killed_run_ends_in_the_map_of_one_that_ran_through(database, whole, left, tmp_path):
    _same(_run(database, left), whole)
    early = tmp_path / "early"
    _kill(database, early, 7)  # before anything was worth keeping
    assert Snapshots(early / "snapshots").newest("") is None
    _same(_run(database, early), whole)


def test_what_was_done_is_not_done_again(database, whole, left, monkeypatch):
    before = Snapshots(left / "snapshots").newest("00-")
    assert before is not None and 12 <= before[0].num_reg_images() <= 27
    registered = []
    register = Incremental._register_next

    def counting(self, mapper, model):
        image_id = register(self, mapper, model)
        registered.append(image_id)
        return image_id

    monkeypatch.setattr(Incremental, "_register_next", counting)
    _run(database, left)
    again = [image_id for image_id in registered if image_id is not None]
    assert len(again) == FRAMES - before[0].num_reg_images()

    def never(*_):
        raise AssertionError("structure from motion that was finished ran again")

    monkeypatch.setattr(Incremental, "_batch", never)
    counted: list[int] = []
    _same(_run(database, left, counted), whole)
    assert len(counted) == FRAMES  # the progress says so, too


def test_a_snapshot_that_was_cut_is_not_taken(database, whole, left):
    newest = sorted((left / "snapshots").iterdir())[-1]
    points = newest / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-1])  # more, and COLMAP asks for 4 GB first
    (left / "snapshots" / "00-999999.part").mkdir()
    _same(_run(database, left), whole)


def test_snapshots_are_whole_or_none_and_the_two_newest_stay(tmp_path):
    model = colmap.reread(two_images.write(tmp_path / "model"))
    snapshots = Snapshots(tmp_path / "kept")
    for number in range(4):
        snapshots.save(f"00-{number}", model, batch=number)
    snapshots.sweep("00-")
    assert snapshots.names() == ["00-2", "00-3"]
    found = snapshots.newest("00-")
    assert found is not None and found[1] == {"batch": 3}
    assert snapshots.newest("01-") is None
    for state in ("[]", "", '{"batch": "x"}'):
        (tmp_path / "kept" / "00-3" / "state.json").write_text(state)
        found = snapshots.newest("00-")
        assert found is not None and found[1] == {"batch": 2}
    (tmp_path / "kept" / "00-2" / "images.bin").unlink()
    assert snapshots.newest("00-") is None
    assert Snapshots(tmp_path / "kept").names() == ["00-2", "00-3"]


def test_a_model_that_the_disk_did_not_take_is_told(tmp_path, monkeypatch):
    folder = two_images.write(tmp_path / "model")
    model = colmap.reread(folder)

    class Full:
        """COLMAP's own writer says nothing when the disk is full."""

        def __getattr__(self, name):
            return getattr(model, name)

        def write(self, target):
            model.write(target)
            points = Path(target) / "points3D.bin"
            points.write_bytes(points.read_bytes()[:40])

    with pytest.raises(MapError, match=r"points3D\.bin: was not written whole; is the disk full\?"):
        Snapshots(tmp_path / "kept").save("00-0", Full())
    assert Snapshots(tmp_path / "kept").names() == []


def test_the_first_pair_does_not_depend_on_which_thread_is_ready_first(database, tmp_path):
    found = set()
    for _ in range(20):
        mapping = Incremental(database, tmp_path, Wanted(0, 4, 1.5, FRAMES), lambda: None)
        pair = mapping._first_pair(mapping._mapper([]), 1)
        assert pair is not None
        found.add(tuple(sorted(pair.reg_image_ids())))
    assert len(found) == 1
