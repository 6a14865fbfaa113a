"""int8 forms: close to the model, of their own name, compared with it in one run."""

from __future__ import annotations

from pathlib import Path

import cv2
import made_up
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from ground_station.feature_models import homographic, quantize
from ground_station.features import inference, inspection
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import Model


def picture(seed: int, shape: tuple[int, int] = (96, 128)) -> np.ndarray:
    """Blobs of several sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros(shape)
    for size in (6, 12, 24):
        coarse = rng.uniform(0, 85, (shape[0] // size + 2, shape[1] // size + 2))
        total += cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return total.clip(0, 255).astype(np.uint8)


IMAGES = [picture(seed) for seed in range(4)]


@pytest.fixture(scope="module", params=["cells", "pixels"])
def fp32(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Model:
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "cells":
        return inspection.read(made_up.write_cells(folder, made_up.info(), (32, 32, 64)))
    about = made_up.info(layout="pixels", multiple=32)
    return inspection.read(made_up.write_pixels(folder, about))


@pytest.fixture(scope="module")
def int8(fp32: Model, tmp_path_factory: pytest.TempPathFactory) -> Model:
    data, info = quantize.int8(fp32, IMAGES, "made-up-int8")
    path = tmp_path_factory.mktemp("int8") / f"{info.name}.onnx"
    path.write_bytes(data)
    return inspection.read(path)


def outputs(found: Model, image: np.ndarray) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession(found.data, providers=["CPUExecutionProvider"])
    names = [each.name for each in session.get_outputs()]
    blob = inference.network_input(found.info, image)
    return dict(zip(names, session.run(names, {"image": blob}), strict=True))


def test_a_form_says_nearly_what_the_model_says(fp32: Model, int8: Model) -> None:
    whole, less = outputs(fp32, IMAGES[0]), outputs(int8, IMAGES[0])
    assert whole.keys() == less.keys()
    for name, wanted in whole.items():
        error = np.sqrt(np.mean((less[name] - wanted) ** 2)) / wanted.std()
        assert 0 < error < 0.1, (name, error)


def test_an_int8_form_computes_with_integers_but_for_the_heads(fp32: Model, int8: Model) -> None:
    graph = onnx.load_model_from_string(int8.data).graph
    makers = {name: node.op_type for node in graph.node for name in node.output}
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    kinds = [makers.get(node.input[1], "float") for node in graph.node if node.op_type == "Conv"]
    heads = 2 if fp32.info.layout == "cells" else 1
    assert kinds.count("DequantizeLinear") == len(kinds) - heads and kinds.count("float") == heads
    weights = [array for array in constants.values() if array.dtype == np.int8 and array.ndim == 4]
    assert len(weights) == len(kinds) - heads
    for array in weights:  # one scale a channel: each uses the whole range of seven bits
        assert np.all(np.abs(array.astype(int)).max(axis=(1, 2, 3)) == 64)


def test_a_form_is_a_model_of_its_own(fp32: Model, int8: Model) -> None:
    assert int8.info.name == "made-up-int8" and int8.sha256 != fp32.sha256
    assert int8.info.source.endswith(f"; int8 of made-up {fp32.sha256[:16]}")
    assert (int8.info.licence, int8.info.layout) == (fp32.info.licence, fp32.info.layout)
    with pytest.raises(FeatureError, match="'made-up-int8' is no fp32 model"):
        quantize.int8(int8, IMAGES, "again")


def test_without_pictures_nothing_is_quantized(fp32: Model) -> None:
    with pytest.raises(FeatureError, match="needs pictures to calibrate by"):
        quantize.int8(fp32, [], "x")


def test_a_warp_shows_an_inner_part_and_says_where(tmp_path: Path) -> None:
    image = picture(5, (120, 160))
    warped, matrix = homographic.warp(image, np.random.default_rng(3))
    assert warped.shape == image.shape and warped.min() > 0
    for x, y in ((20, 30), (80, 60), (150, 100)):
        back = np.linalg.inv(matrix) @ (x, y, 1)
        u, v = back[:2] / back[2]
        assert 0 <= u <= 159 and 0 <= v <= 119
        patch = cv2.getRectSubPix(image, (3, 3), (float(u), float(v))).astype(float)
        assert abs(patch.mean() - warped[y, x]) < 12
    again, same = homographic.warp(image, np.random.default_rng(3))
    assert np.array_equal(warped, again) and np.array_equal(matrix, same)


def test_frames_are_taken_evenly_in_one_pass() -> None:
    class Source:
        camera, notes = None, []  # type: ignore[var-annotated]

        def __init__(self, count: int) -> None:
            self._count = count

        def __iter__(self):
            for number in range(self._count):
                yield type("Frame", (), {"image": np.full((16, 16), number % 251, np.uint8)})

        def count(self) -> int | None:
            return None

    for total, wanted in ((3, 3), (8, 8), (100, 8), (1001, 8)):
        kept = quantize.evenly(Source(total), 8)
        assert len(kept) == wanted
    numbers = [int(image[0, 0]) for image in quantize.evenly(Source(200), 8)]
    gaps = np.diff(numbers)
    assert numbers[0] == 0 and numbers[-1] > 160 and gaps.max() <= 2 * gaps.min()


def test_a_model_beside_itself_loses_nothing(fp32: Model) -> None:
    result = quantize.compare(fp32, fp32, IMAGES[:2], threads=1, seed=4)
    assert result.reference == result.variant and result.pairs == 2
    assert result.reference.matches > 10 and 0 <= result.reference.accuracy <= 1
    assert result.time_ratio == result.variant_ms / result.reference_ms > 0


def test_a_model_with_other_weights_loses_accuracy(tmp_path: Path) -> None:
    """The measure tells a good model from a spoilt one: descriptors that know nothing."""
    fp32 = inspection.read(made_up.write_cells(tmp_path, made_up.info(), (32, 32, 64)))
    proto = onnx.load_model_from_string(fp32.data)
    for tensor in proto.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.shape[:1] == (16,):
            spoilt = (
                values * np.float32(1e-30) + np.arange(16, dtype=np.float32)[:, None, None, None]
            )
            tensor.CopyFrom(numpy_helper.from_array(spoilt, tensor.name))
    bad = Model(fp32.path, fp32.info, proto.SerializeToString(), "0" * 64)
    result = quantize.compare(fp32, bad, IMAGES, threads=1, seed=4)
    assert result.variant.accuracy < result.reference.accuracy - 0.1
