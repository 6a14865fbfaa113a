"""The rooms on disk: made once, resumable, refused when they are others' or damaged."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ground_station.feature_models import images
from ground_station.training import corpus, rooms
from ground_station.training.corpus import CorpusSettings
from ground_station.training.errors import TrainingError

SIZE = (128, 160)
SETTINGS = CorpusSettings(seed=3, rooms=2, places=3, rows=SIZE[0], columns=SIZE[1])


def painted(seed: int, number: int, places: int, lights: int, size: tuple[int, int]):
    """In place of drawn rooms, which take seconds."""
    for place in range(places):
        one = images.procedural(seed, 8 * number + place, size)
        yield np.stack([one // (light + 1) for light in range(lights)])


@pytest.fixture
def quickly(monkeypatch) -> None:
    """Painted rooms, by threads: a new process would have to draw them."""
    monkeypatch.setattr(rooms, "views_of_room", painted)
    monkeypatch.setattr(corpus.signal, "signal", lambda *_: None)
    monkeypatch.setattr(corpus, "ProcessPoolExecutor", lambda jobs, _: ThreadPoolExecutor(jobs))


@pytest.fixture
def folder(tmp_path, quickly) -> Path:
    for number in range(SETTINGS.rooms):
        corpus._make_shard(SETTINGS, number, corpus.shard_path(tmp_path, number))
    return tmp_path


def test_a_room_comes_back_nearly_as_it_was_drawn(folder):
    views = corpus.read(folder, 1, SIZE)
    assert views.shape == (3, 2, *SIZE) and views.dtype == np.uint8
    wanted = np.stack(list(painted(3, 1, 3, 2, SIZE)))
    assert np.abs(views.astype(int) - wanted).mean() < 4
    assert corpus.shard_path(folder, 1).stat().st_size < wanted.nbytes / 2


def test_a_killed_corpus_goes_on_and_another_is_refused(tmp_path, quickly):
    few = replace(SETTINGS, rooms=2, places=1)
    corpus.make(tmp_path, few, jobs=1)
    path = corpus.shard_path(tmp_path, 0)
    whole = path.read_bytes()
    path.unlink()
    corpus.make(tmp_path, few, jobs=1)
    assert path.read_bytes() == whole
    stood = path.stat().st_mtime_ns
    corpus.make(tmp_path, few, jobs=1)
    assert path.stat().st_mtime_ns == stood
    with pytest.raises(TrainingError, match="other settings"):
        corpus.make(tmp_path, replace(few, seed=4), jobs=1)


def test_settings_that_make_no_corpus_are_refused():
    with pytest.raises(TrainingError, match="130x128 px; both must be multiples of 32"):
        CorpusSettings(rows=128, columns=130)
    with pytest.raises(TrainingError, match="places is 0; allowed: 1 to 200"):
        CorpusSettings(places=0)


@pytest.mark.parametrize("damage", ["cut", "garbage", "gone", "another size"])
def test_a_damaged_room_is_refused_by_name(folder, damage):
    path = corpus.shard_path(folder, 1)
    data = path.read_bytes()
    size = (SIZE[0] + 32, SIZE[1]) if damage == "another size" else SIZE
    if damage == "gone":
        path.unlink()
    elif damage != "another size":
        path.write_bytes(data[:2000] if damage == "cut" else b"\xff" * 20)
    with pytest.raises(TrainingError, match=r"room-0001\.safetensors") as raised:
        corpus.read(folder, 1, size)
    assert "\n" not in str(raised.value)
