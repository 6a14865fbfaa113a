"""The graphs' operators do in onnxruntime what their docstrings say, and bytes are the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import made_up
import numpy as np
import onnxruntime
import pytest
from reference import operators

from ground_station.feature_models.graph import Graph, batch_norm_terms, fold_batch_norm
from ground_station.features.extractor import FeatureError

RNG = np.random.default_rng(3)
IMAGE = RNG.normal(size=(2, 4, 8, 12)).astype(np.float32)


def ran(
    make: Callable[[Graph, str], str], channels: int = 4, image: np.ndarray = IMAGE
) -> np.ndarray:
    """What onnxruntime makes of an image (N, C, H, W) by a graph whose result has `channels`."""
    graph = Graph("part")
    graph.output(make(graph, graph.input("image", image.shape[1])), "result", channels)
    data = graph.model(made_up.info())
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    return np.asarray(session.run(["result"], {"image": image})[0])


def each(function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The reference's result for both pictures."""
    return np.stack([function(picture.astype(np.float64)) for picture in IMAGE])


def close(found: np.ndarray, wanted: np.ndarray) -> bool:
    return found.shape == wanted.shape and bool(np.allclose(found, wanted, atol=1e-5))


def test_convolutions_are_the_references() -> None:
    weight, bias = RNG.normal(size=(5, 4, 3, 3)), RNG.normal(size=5)
    wanted = each(lambda x: operators.convolution(x, weight, bias))
    assert close(ran(lambda g, x: g.conv(x, weight, bias), 5), wanted)
    # With stride 2 every second pixel of the same is left, from the first on.
    assert close(ran(lambda g, x: g.conv(x, weight, bias, stride=2), 5), wanted[..., ::2, ::2])


def test_pools_and_gates_are_the_references() -> None:
    assert close(ran(lambda g, x: g.relu(x)), each(operators.relu))
    assert close(ran(lambda g, x: g.sigmoid(x)), each(operators.sigmoid))
    assert close(ran(lambda g, x: g.max_pool(x, 4)), each(lambda x: operators.max_pool(x, 4)))
    sums = ran(lambda g, x: g.concat([g.add(x, x), x]), 8)
    assert close(sums, np.concatenate([2 * IMAGE, IMAGE], axis=1))


def test_enlarging_is_bilinear_in_both_conventions() -> None:
    wanted = each(lambda x: operators.upsample_align_corners(x, 2))
    assert close(ran(lambda g, x: g.resize_bilinear(x, 2, align_corners=True)), wanted)
    row = np.array([0, 4, 8], np.float32).reshape(1, 1, 1, 3)
    found = ran(lambda g, x: g.resize_bilinear(x, 2), 1, row)
    assert found[0, 0].tolist() == [[0, 1, 3, 5, 7, 8]] * 2


def test_vectors_get_unit_length_and_nought_stays_nought() -> None:
    image = IMAGE.copy()
    image[0, :, 0, 0] = 0
    found = ran(lambda g, x: g.l2_normalize(x), 4, image)
    length = np.linalg.norm(found, axis=1)
    assert length[0, 0, 0] == 0 and np.allclose(np.delete(length.ravel(), 0), 1, atol=1e-6)


def test_batch_norms_fold_into_the_convolution_before() -> None:
    weight, bias = RNG.normal(size=(6, 4, 3, 3)), RNG.normal(size=6)
    norm = (RNG.normal(size=6), RNG.normal(size=6), RNG.normal(size=6), RNG.uniform(0, 2, 6))
    wanted = each(
        lambda x: operators.batch_norm(operators.convolution(x, weight, bias), norm, 1e-3)
    )
    folded = fold_batch_norm(weight, bias, *norm, 1e-3)
    assert close(ran(lambda g, x: g.conv(x, *folded), 6), wanted)
    terms = batch_norm_terms(*norm, 1e-3)
    assert close(ran(lambda g, x: g.scale_shift(g.conv(x, weight, bias), *terms), 6), wanted)


def test_the_same_calls_make_the_same_bytes(tmp_path: Path) -> None:
    first = made_up.write_cells(tmp_path, made_up.info()).read_bytes()
    (tmp_path / "again").mkdir()
    again = made_up.write_cells(tmp_path / "again", made_up.info())
    assert again.read_bytes() == first
    assert sorted(path.name for path in again.parent.iterdir()) == [again.name]
    other = made_up.write_cells(tmp_path, made_up.info(name="other"))
    assert other.read_bytes() != first


def test_an_input_can_be_an_output_and_a_tensor_two() -> None:
    graph = Graph("twice")
    x = graph.input("image", 4)
    graph.output(x, "same", 4)
    graph.output(graph.output(graph.relu(x), "first", 4), "second", 4)
    session = onnxruntime.InferenceSession(
        graph.model(made_up.info()), providers=["CPUExecutionProvider"]
    )
    same, first, second = session.run(["same", "first", "second"], {"image": IMAGE})
    assert np.array_equal(same, IMAGE)
    assert np.array_equal(first, second) and np.array_equal(first, np.maximum(IMAGE, 0))


def test_what_does_not_fit_is_refused_in_one_line(tmp_path: Path) -> None:
    graph = Graph("bad")
    with pytest.raises(FeatureError, match=r"^bad: the weights of Conv_0.weight are not all fin"):
        graph.conv(graph.input("image", 1), np.full((1, 1, 3, 3), np.nan))
    graph = Graph("bad")
    graph.output(graph.add(graph.input("image", 1), "nothing"), "logits", 65)
    with pytest.raises(FeatureError, match="made-up: the network does not fit together") as caught:
        graph.save(tmp_path / "bad.onnx", made_up.info())
    assert len(str(caught.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())
