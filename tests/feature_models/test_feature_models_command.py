"""`blimp models`: what it prints and writes, and that an error is one line and status 2."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import made_up
import numpy as np
import pytest
import torch_files
from reference import networks
from safetensors.numpy import save

from ground_station import cli
from ground_station.feature_models import importer
from ground_station.features import catalogue, extractors
from ground_station.features.extractor import FeatureError


@pytest.fixture(autouse=True)
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where models come to; their scale, which has tests of its own, is not measured."""
    folder = tmp_path / "models"
    monkeypatch.setenv("BLIMP_MODELS", str(folder))
    monkeypatch.setattr(importer.scale, "measured", lambda data, info: 1.25)
    return folder


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for number in range(6):
        coarse = rng.integers(0, 256, (12, 16), dtype=np.uint8)
        image = cv2.resize(coarse, (128, 96), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def test_import_info_and_list_tell_the_same(
    tmp_path: Path, models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tmp_path / "alike-t.safetensors"
    weights.write_bytes(save(networks.alike_weights("t")))
    told = tmp_path / "told.json"
    assert cli.main(["models", "import", str(weights), "--json", str(told)]) == 0
    out = capsys.readouterr().out
    assert f"written: {models / 'alike-t.onnx'}" in out and "licence: BSD-3-Clause" in out
    brought = json.loads(told.read_text())
    assert brought["sha256"] == catalogue.find("alike-t").sha256
    assert brought["gmac_640x480"] == pytest.approx(1.944, abs=0.001)
    assert cli.main(["models", "info", "alike-t", "--json", str(told)]) == 0
    assert json.loads(told.read_text()) == brought
    assert brought["sha256"] in capsys.readouterr().out
    assert cli.main(["models", "list", "--json", str(told)]) == 0
    assert brought in json.loads(told.read_text())["models"]
    out = capsys.readouterr().out
    assert "alike-t " in out and "methods without a model: orb, rootsift" in out


def test_a_file_that_is_no_model_is_listed_with_the_reason(
    models: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models.mkdir()
    (models / "broken.onnx").write_bytes(b"\x08\x08")
    assert cli.main(["models", "list"]) == 0
    assert f"{models / 'broken.onnx'}: not an ONNX file" in capsys.readouterr().out


def test_a_name_and_a_licence_can_be_given(tmp_path: Path) -> None:
    weights = tmp_path / "mine.pth"
    weights.write_bytes(torch_files.legacy_of(networks.superpoint_weights()))
    words = ["models", "import", str(weights), "--name", "mine", "--licence", "our own"]
    assert cli.main(words) == 0
    info = catalogue.find("mine").info
    assert (info.name, info.licence, info.layout) == ("mine", "our own", "cells")


def test_quantize_says_what_is_lost_and_what_is_won(
    tmp_path: Path, models: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models.mkdir()
    made_up.write_cells(models, made_up.info(), (16, 16, 32))
    told = tmp_path / "told.json"
    words = ["models", "quantize", "made-up", "--calibrate", str(frames)]
    assert cli.main([*words, "--json", str(told)]) == 0
    document = json.loads(told.read_text())
    assert document["pairs"] == 3 and document["image_px"] == [128, 96]
    assert document["model"]["name"] == "made-up-int8"
    for each in ("fp32", "int8"):
        assert 0 <= document[each]["accuracy_3px"] <= 1
        assert document[each]["correct"] <= document[each]["matches"]
    out = capsys.readouterr().out
    points = 100 * (document["int8"]["accuracy_3px"] - document["fp32"]["accuracy_3px"])
    assert f"matching accuracy {points:+.1f} points over 3 pairs" in out
    assert f"time of the network: {document['time_ratio']:.2f} at 128x96" in out
    assert catalogue.find("made-up-int8").sha256 == document["model"]["sha256"]
    assert cli.main(words) == 2
    assert "there is a model 'made-up-" in capsys.readouterr().err


def _refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.main(["models", *words]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == captured.err.count("blimp models: ") + captured.err.count(
        "frames: "
    )
    return captured.err


def test_what_a_person_gets_wrong_is_one_line(
    tmp_path: Path, models: Path, frames: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models.mkdir()
    made_up.write_cells(models, made_up.info(), (8, 8, 8))
    one = tmp_path / "one"
    one.mkdir()
    (one / "0.png").write_bytes((frames / "0.png").read_bytes())
    weights = tmp_path / "other.pth"
    weights.write_bytes(save({"fc": np.zeros(2, np.float32)}))
    quantize = ["quantize", "made-up", "--calibrate"]
    for words, says in (
        (["import", str(tmp_path / "none.pth")], "none.pth: No such file or directory"),
        (["import", str(weights)], "other.pth: neither SuperPoint nor ALIKE"),
        (["info", "nothing"], "there is no model 'nothing' (known: lark, made-up, wren)"),
        ([*quantize, str(tmp_path / "none")], "none: No such file or directory"),
        ([*quantize, str(one)], "1 frames; at least 2 are needed"),
        ([*quantize, str(frames), "--frames", "3"], "--frames is 3; allowed: 4 to 512"),
        ([*quantize, str(frames), "--threads", "0"], "--threads is 0; allowed: 1 to 64"),
        ([*quantize, str(frames), "--range", "5:2"], "the range '5:2' is not"),
        ([*quantize, str(frames), "--name", "orb"], "name is 'orb', which is a method's"),
    ):
        assert says in _refused(words, capsys), words
    assert catalogue.names() == ["lark", "made-up", "wren"]


def test_a_folder_that_cannot_be_made_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path / "file" / "models"))
    weights = tmp_path / "alike-t.safetensors"
    weights.write_bytes(save(networks.alike_weights("t")))
    assert "Not a directory" in _refused(["import", str(weights)], capsys)


@pytest.mark.parametrize("name", ["superpoint", "superpoint-open", "alike", "alike-n"])
def test_a_network_that_is_not_here_yet_names_the_command_that_brings_it(name: str) -> None:
    with pytest.raises(FeatureError, match="bring your own: blimp models import FILE"):
        extractors.create(name)
