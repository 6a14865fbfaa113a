"""SuperPoint in both layouts and ALIKE, from a file to onnxruntime, against numpy's reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch_files
from onnx import numpy_helper
from reference import networks
from safetensors.numpy import save

from ground_station.feature_models import importer, torch_file
from ground_station.feature_models.torch_file import WeightsError
from ground_station.features import catalogue, detection
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import Model

MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"
RNG = np.random.default_rng(9)
GREY = RNG.random((48, 80))
RGB = RNG.random((3, 64, 96))

SUPERPOINT = networks.superpoint_weights()
PORT = networks.superpoint_port_weights()


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where models come to; their scale, which has tests of its own, is not measured each time."""
    folder = tmp_path / "models"
    monkeypatch.setenv("BLIMP_MODELS", str(folder))
    monkeypatch.setattr(importer.scale, "measured", lambda data, info: 1.25)
    return folder


def brought(tmp_path: Path, data: bytes, name: str | None = None) -> Model:
    path = tmp_path / "weights.pth"
    path.write_bytes(data)
    return importer.import_weights(path, name)


def outputs(found: Model, image: np.ndarray) -> list[np.ndarray]:
    names = ["logits" if found.info.layout == "cells" else "scores", "descriptors"]
    session = onnxruntime.InferenceSession(found.data, providers=["CPUExecutionProvider"])
    return [np.asarray(v[0]) for v in session.run(names, {"image": image.astype(np.float32)[None]})]


@pytest.mark.parametrize("pack", [torch_files.zip_of, torch_files.legacy_of], ids=["zip", "legacy"])
@pytest.mark.parametrize(
    ("weights", "reference"),
    [(SUPERPOINT, networks.superpoint), (PORT, networks.superpoint_port)],
    ids=["magic-leap", "port"],
)
def test_superpoint_is_the_reference(
    tmp_path: Path, weights: dict, reference: Callable, pack: Callable
) -> None:
    found = brought(tmp_path, pack(weights))
    assert (found.info.layout, found.info.dimension, found.info.multiple) == ("cells", 256, 8)
    assert found.info.distance_scale == 1.25
    for name, mine, wanted in zip(
        ("logits", "descriptors"), outputs(found, GREY[None]), reference(weights, GREY), strict=True
    ):
        assert mine.shape == (65 if name == "logits" else 256, 6, 10)
        assert np.abs(mine - wanted).max() < 1e-4, name
        assert wanted.std() > 0.1


@pytest.mark.parametrize("size", "tsnl")
def test_alike_is_the_reference(tmp_path: Path, size: str) -> None:
    weights = networks.alike_weights(size)
    found = brought(tmp_path, save(weights))
    assert found.info.name == f"alike-{size}" and found.info.multiple == 32
    scores, descriptors = outputs(found, RGB)
    wanted_scores, wanted = networks.alike(weights, RGB)
    assert np.abs(scores - wanted_scores).max() < 1e-4 and wanted_scores.std() > 0.01
    assert descriptors.shape == wanted.shape == (found.info.dimension, 64, 96)
    assert np.abs(descriptors - wanted).max() < 1e-4


@pytest.mark.skipif(not MODELS.is_dir(), reason="../shared/models is not there")
@pytest.mark.parametrize("size", "tnl")
def test_published_alike_is_the_reference(tmp_path: Path, size: str) -> None:
    path = MODELS / f"alike-{size}.safetensors"
    found = importer.import_weights(path)
    scores, descriptors = outputs(found, RGB)
    wanted_scores, wanted = networks.alike(torch_file.read(path).tensors, RGB)
    assert np.abs(scores - wanted_scores).max() < 1e-4
    assert np.abs(descriptors - wanted).max() < 1e-4
    assert "BSD-3-Clause" in found.info.licence


def test_the_weights_are_in_the_model_bit_by_bit(tmp_path: Path) -> None:
    """Each convolution has the bytes of the file, in the order in which the network runs."""
    graph = onnx.load_model_from_string(
        brought(tmp_path, torch_files.zip_of(SUPERPOINT)).data
    ).graph
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    order = [f"conv{n}{letter}" for n in "1234" for letter in "ab"]
    order += ["convPa", "convPb", "convDa", "convDb"]
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    assert len(convolutions) == len(order) == 12
    for name, node in zip(order, convolutions, strict=True):
        for part, constant in zip(("weight", "bias"), node.input[1:], strict=True):
            assert constants[constant].tobytes() == SUPERPOINT[f"{name}.{part}"].tobytes()
            assert constants[constant].shape == SUPERPOINT[f"{name}.{part}"].shape


def test_a_channel_of_the_logits_is_its_pixel_of_the_cell(tmp_path: Path) -> None:
    """A detector whose biases are all that it says sees a point at row k // 8, column k % 8."""
    for k in (7, 29):
        weights = {name: np.zeros_like(array) for name, array in SUPERPOINT.items()}
        weights["convPb.bias"][k] = 9
        found = brought(tmp_path, torch_files.zip_of(weights), f"channel-{k}")
        logits, _ = outputs(found, GREY[None])
        assert np.all(logits[k] == 9) and not np.any(np.delete(logits, k, axis=0))
        rows, columns = np.nonzero(detection.cell_scores(logits) > 0.5)
        assert len(rows) == 60 and np.all(rows % 8 == k // 8) and np.all(columns % 8 == k % 8)


def test_the_same_weights_are_the_same_model_again(tmp_path: Path, own_folder: Path) -> None:
    first = brought(tmp_path, torch_files.zip_of(SUPERPOINT))
    again = brought(tmp_path, torch_files.zip_of(SUPERPOINT))
    assert first.sha256 == again.sha256
    assert [path.name for path in own_folder.iterdir()] == ["superpoint.onnx"]
    assert catalogue.find("superpoint").sha256 == first.sha256


@pytest.mark.parametrize(
    ("weights", "name"),
    [
        (SUPERPOINT, "conv1b.weight"),
        (SUPERPOINT, "conv4a.bias"),
        (SUPERPOINT, "convDb.weight"),
        (PORT, "backbone.2.1.bn.running_var"),
        (PORT, "descriptor.1.conv.bias"),
        (networks.alike_weights("t"), "block3.downsample.weight"),
        (networks.alike_weights("t"), "conv4.weight"),
        (networks.alike_weights("l"), "convhead1.weight"),
    ],
)
def test_a_missing_or_wrong_tensor_is_named(tmp_path: Path, weights: dict, name: str) -> None:
    path = tmp_path / "weights.pth"
    shape = "x".join(map(str, weights[name].shape))
    for change, says in (
        (None, f"the tensor {name} is missing"),
        (np.zeros((*weights[name].shape, 2), np.float32), f"{shape}x2; it should be {shape}"),
        (np.full_like(weights[name], np.inf), f"the tensor {name} has values that are not finite"),
    ):
        bad = {**weights, name: change}
        if change is None:
            del bad[name]
        path.write_bytes(save(bad))
        with pytest.raises(WeightsError) as caught:
            importer.import_weights(path)
        line = str(caught.value)
        assert line.startswith(f"{path}: ") and says in line and len(line.splitlines()) == 1
    assert not (tmp_path / "models").exists()


@pytest.mark.parametrize(
    ("weights", "says"),
    [
        ({"fc.weight": np.zeros(3, np.float32)}, "neither SuperPoint nor ALIKE: of its 1 tensors"),
        (
            {f"block{n}.conv1.weight": np.zeros((5, 3, 3, 3), np.float32) for n in range(1, 5)}
            | {"convhead2.weight": np.zeros((65, 64, 1, 1), np.float32)},
            "blocks of 5, 5, 5, 5 channels; known are the sizes t, s, n, l",
        ),
        (
            {**PORT, "backbone.0.0.bn.running_var": np.full(64, -1, np.float32)},
            "backbone.0.0.bn.running_var has negative values",
        ),
    ],
)
def test_another_network_is_refused(tmp_path: Path, weights: dict, says: str) -> None:
    with pytest.raises(WeightsError, match=says):
        brought(tmp_path, save(weights))


def test_a_name_that_is_taken_or_none_is_refused_and_the_old_model_stays(tmp_path: Path) -> None:
    first = brought(tmp_path, torch_files.zip_of(SUPERPOINT), "mine")
    for weights, name, says in (
        (PORT, "mine", "there is another model 'mine'"),
        (PORT, "rootsift", "a method's"),
        (PORT, "../mine", r"name is '\.\./mine'"),
    ):
        with pytest.raises(FeatureError, match=says):
            brought(tmp_path, torch_files.zip_of(weights), name)
    assert catalogue.names() == sorted({*catalogue.names(), "mine"})
    assert catalogue.find("mine").sha256 == first.sha256
