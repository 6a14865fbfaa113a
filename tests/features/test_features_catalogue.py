"""Models are found by name, those that ship and the user's; what is ambiguous is refused."""

from __future__ import annotations

import made_up
import pytest

from ground_station.features import catalogue, extractors
from ground_station.features.extractor import FeatureError


@pytest.fixture
def folders(tmp_path, monkeypatch):
    shipped, users = tmp_path / "shipped", tmp_path / "users"
    shipped.mkdir()
    users.mkdir()
    monkeypatch.setattr(catalogue, "SHIPPED", shipped)
    monkeypatch.setenv("BLIMP_MODELS", str(users))
    return shipped, users


def test_names_are_those_of_both_folders_and_of_the_methods(folders):
    shipped, users = folders
    made_up.write_cells(shipped, made_up.info("bird"))
    made_up.write_cells(users, made_up.info("mine"))
    (users / "notes.txt").write_text("no model")
    assert catalogue.names() == ["bird", "mine"]
    assert extractors.names() == ["bird", "mine", "orb", "rootsift"]
    assert catalogue.find("mine").path == users / "mine.onnx"
    assert extractors.create("bird").sha256 == catalogue.find("bird").sha256


def test_a_name_that_is_not_there_is_refused_with_the_known_ones(folders):
    made_up.write_cells(folders[0], made_up.info("bird"))
    with pytest.raises(FeatureError, match=r"no model 'fish' \(known: bird\)"):
        catalogue.find("fish")
    with pytest.raises(FeatureError, match=r"no extractor 'fish' \(known: bird, orb, rootsift\)"):
        extractors.create("fish")


def test_two_models_of_one_name_are_refused_and_two_copies_of_one_are_not(folders):
    shipped, users = folders
    path = made_up.write_cells(shipped, made_up.info("bird"))
    (users / "bird.onnx").write_bytes(path.read_bytes())
    assert catalogue.find("bird").path == path
    made_up.write_cells(users, made_up.info("bird"), seed=1)
    with pytest.raises(FeatureError, match=r"two models are named 'bird', .*shipped.* and .*users"):
        catalogue.find("bird")


def test_a_file_that_is_called_otherwise_than_its_model_is_refused(folders):
    path = made_up.write_cells(folders[1], made_up.info("bird"))
    path.rename(folders[1] / "fish.onnx")
    with pytest.raises(FeatureError, match=r"named 'bird'; the file must be called bird\.onnx"):
        catalogue.find("fish")


def test_a_folder_that_is_not_there_holds_none(folders, monkeypatch):
    monkeypatch.setenv("BLIMP_MODELS", str(folders[1] / "none"))
    assert catalogue.names() == []


def test_the_users_folder_is_where_xdg_says(monkeypatch, tmp_path):
    monkeypatch.delenv("BLIMP_MODELS", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert catalogue.path_for("mine") == tmp_path / "blimp" / "models" / "mine.onnx"
    monkeypatch.setenv("XDG_DATA_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert catalogue.users() == tmp_path / ".local" / "share" / "blimp" / "models"


def test_a_new_model_takes_no_methods_name_and_no_path():
    for name in ("orb", "rootsift", "map"):
        with pytest.raises(FeatureError, match="is a method's"):
            extractors.check_free(name)
    with pytest.raises(FeatureError, match="name is"):
        catalogue.path_for("../../etc/x")
    extractors.check_free("superpoint")
