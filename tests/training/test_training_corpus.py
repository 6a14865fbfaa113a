"""The corpus on disk: made once, resumable, refused when it is another or damaged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import training_models

from ground_station.feature_models import images
from ground_station.features import model
from ground_station.features.inference import Network
from ground_station.training import corpus
from ground_station.training.corpus import Corpus, CorpusSettings
from ground_station.training.errors import TrainingError
from ground_station.training.teacher import Teacher, load, scores_only

SIZE = {"rows": 128, "columns": 160}
SETTINGS = CorpusSettings(
    seed=3, pictures=6, rooms=0, warps=2, points=60, per_shard=3, **SIZE
)  # fmt: skip


@pytest.fixture(scope="module")
def teacher(tmp_path_factory) -> str:
    return training_models.teacher(tmp_path_factory.mktemp("teacher") / "made-up.onnx")


def make(folder: Path, settings: CorpusSettings, teacher: str) -> None:
    """As `corpus.make` does, in this process."""
    worker = Teacher(load(teacher))
    folder.mkdir(exist_ok=True)
    for kind, number in settings.shards():
        path = corpus.shard_path(folder, kind, number)
        if not path.exists():
            corpus.make_shard(settings, kind, number, path, worker)


def test_the_detector_alone_scores_as_the_whole_network_does(teacher):
    whole = model.read(teacher)
    picture = np.random.default_rng(0).random((1, 3, 96, 128)).astype(np.float32)
    wanted = Network(whole).run(picture)["scores"]
    alone = Network(scores_only(whole)).run(picture)
    assert set(alone) == {"scores"} and np.ptp(wanted) > 0.1
    assert alone["scores"] == pytest.approx(wanted, abs=1e-5)


def test_labels_are_points_that_are_found_again_in_turned_pictures(teacher):
    labelled = Teacher(load(teacher))
    picture = images.procedural(3, 7, (128, 160))
    labels = labelled.label(picture[None], 4, 60, np.random.default_rng(1))
    n = len(labels.scores)
    assert 5 < n <= 60 and labels.points_px.shape == (n, 2)
    assert (np.diff(labels.scores) <= 1e-6).all()  # strongest first
    assert np.linalg.norm(labels.descriptors.astype(float), axis=1) == pytest.approx(1, abs=1e-2)
    again = labelled.label(picture[None], 4, 60, np.random.default_rng(1))
    assert (again.points_px == labels.points_px).all()


def test_a_killed_corpus_goes_on_and_is_the_same(tmp_path, teacher):
    make(tmp_path, SETTINGS, teacher)
    paths = [corpus.shard_path(tmp_path, *shard) for shard in SETTINGS.shards()]
    assert len(paths) == 2
    whole = [path.read_bytes() for path in paths]
    stood = paths[0].stat().st_mtime_ns
    paths[1].unlink()
    (tmp_path / "pictures-0001.safetensors.part").write_bytes(b"cut")
    make(tmp_path, SETTINGS, teacher)
    assert [path.read_bytes() for path in paths] == whole
    assert paths[0].stat().st_mtime_ns == stood
    places = Corpus(tmp_path, SETTINGS)
    assert len(places) == 6
    assert places[4].views.shape == (1, 128, 160)
    assert places[4].descriptors.shape == (len(places[4].points_px), 8)


def test_worker_processes_make_the_same_and_another_corpus_is_refused(tmp_path, teacher):
    make(tmp_path / "here", SETTINGS, teacher)
    corpus.make(tmp_path / "there", SETTINGS, teacher, jobs=1)
    for shard in SETTINGS.shards():
        here, there = (corpus.shard_path(tmp_path / w, *shard) for w in ("here", "there"))
        assert here.read_bytes() == there.read_bytes()
    other = replace(SETTINGS, seed=4)
    with pytest.raises(TrainingError, match="other settings"):
        corpus.make(tmp_path / "there", other, teacher, jobs=1)


def test_settings_that_make_no_corpus_are_refused():
    with pytest.raises(TrainingError, match="both 0"):
        CorpusSettings(pictures=0, rooms=0)
    with pytest.raises(TrainingError, match="130x128 px; both must be multiples of 32"):
        CorpusSettings(rows=128, columns=130)
    with pytest.raises(TrainingError, match="lights is 9; allowed: 1 to 8"):
        CorpusSettings(lights=9)


@pytest.mark.parametrize("damage", [b"", b"\xff" * 20])
def test_a_damaged_shard_is_refused_by_name(tmp_path, teacher, damage):
    make(tmp_path, SETTINGS, teacher)
    path = corpus.shard_path(tmp_path, "pictures", 1)
    path.write_bytes(damage or path.read_bytes()[:2000])
    with pytest.raises(TrainingError, match=r"pictures-0001\.safetensors") as raised:
        Corpus(tmp_path, SETTINGS)
    assert "\n" not in str(raised.value)


def test_a_teacher_of_another_layout_is_refused(tmp_path):
    from ground_station.training import export
    from ground_station.training.topology import SHAPES

    path = tmp_path / "cells.onnx"
    export.export(SHAPES["wren"], training_models.weights(SHAPES["wren"]), path, "a test")
    with pytest.raises(TrainingError, match=r"layout .* 'cells', not 'pixels'"):
        load(str(path))
