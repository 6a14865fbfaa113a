"""The networks' shapes and the file that training leaves: what it costs, and that it runs."""

import cv2
import numpy as np
import onnx
import pytest
import training_models

from ground_station.feature_models import images
from ground_station.features import inspection
from ground_station.features.blobs import BlobFeatures
from ground_station.features.inference import Network
from ground_station.features.settings import LearnedSettings
from ground_station.training import export
from ground_station.training.errors import TrainingError
from ground_station.training.topology import OUTPUTS, SHAPES, shape_of


@pytest.fixture(autouse=True)
def scale(monkeypatch) -> None:
    """It has tests of its own, and is not measured each time."""
    monkeypatch.setattr(export.scale, "measured", lambda data, info: 1.25)


def counted(path, rows: int, columns: int) -> int:
    """Products of the file's convolutions, from its own shapes."""
    proto = onnx.load(str(path))
    for axis, size in ((0, 1), (2, rows), (3, columns)):
        proto.graph.input[0].type.tensor_type.shape.dim[axis].dim_value = size
    del proto.graph.value_info[:]
    for output in proto.graph.output:
        output.type.tensor_type.ClearField("shape")
    inferred = onnx.shape_inference.infer_shapes(proto, data_prop=True)
    values = (*inferred.graph.value_info, *inferred.graph.output)
    shapes = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in values}
    weights = {w.name: list(w.dims) for w in inferred.graph.initializer}
    total = 0
    for node in inferred.graph.node:
        if node.op_type == "Conv":
            _, channels, h, w = shapes[node.output[0]]
            assert channels and h and w
            total += h * w * int(np.prod(weights[node.input[1]]))
    return total


def test_what_ships_is_small(tmp_path):
    shape = SHAPES["lark"]
    path = tmp_path / "lark.onnx"
    export.export(shape, training_models.weights(shape), path, "a test")
    assert 0 < counted(path, 480, 640) <= 1.5e9
    assert path.stat().st_size <= 2_000_000
    assert 64 <= shape.dimension <= 128


def test_the_file_is_the_same_each_time_and_extracts(tmp_path):
    shape = SHAPES["lark"]
    paths = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    for path in paths:
        export.export(shape, training_models.weights(shape), path, "a test")
    assert paths[0].read_bytes() == paths[1].read_bytes()
    read = inspection.read(paths[0])
    assert (read.info.name, read.info.layout, read.info.dimension) == ("lark", "blobs", 64)
    assert read.info.distance_scale == 1.25
    picture = images.procedural(1, 0, (120, 168))  # no multiple of 16: it is padded
    found = BlobFeatures(Network(read), 200, LearnedSettings()).extract(picture)
    assert len(found) > 20
    assert np.linalg.norm(found.descriptors, axis=1) == pytest.approx(1, abs=1e-5)
    assert (found.keypoints_px >= 0).all()
    assert (found.keypoints_px <= [167, 119]).all()


def test_normalisation_is_folded_into_the_weights(tmp_path):
    """The graph against the network reckoned layer by layer in numpy, on a small picture."""
    shape = SHAPES["lark"]
    weights = training_models.weights(shape, seed=2)
    path = tmp_path / "lark.onnx"
    export.export(shape, weights, path, "a test")
    picture = np.random.default_rng(0).random((1, 1, 32, 48)).astype(np.float32)
    said = Network(inspection.read(path)).run(picture)
    wanted = shape.build(Reference(weights), picture[0].astype(np.float64))
    for name, values in zip(OUTPUTS, wanted, strict=True):
        assert said[name][0] == pytest.approx(values, abs=1e-3)


class Reference:
    """The operations that the shape needs, plainly, in float64."""

    def __init__(self, weights):
        self.weights = weights

    def conv(self, layer, x):
        pad = layer.size // 2
        x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
        windows = np.lib.stride_tricks.sliding_window_view(x, (layer.size,) * 2, axis=(1, 2))
        windows = windows[:, :: layer.stride, :: layer.stride]
        y = np.einsum("chwij,ocij->ohw", windows, self.weights[f"{layer.name}.weight"])
        if not layer.norm:
            return y + self.weights[f"{layer.name}.bias"][:, None, None]
        scale, shift, mean, var = (
            self.weights[f"{layer.name}.norm.{t}"][:, None, None]
            for t in ("weight", "bias", "mean", "var")
        )
        return (y - mean) / np.sqrt(var + 1e-5) * scale + shift

    def relu(self, x):
        return np.maximum(x, 0)

    def add(self, first, second):
        return first + second

    def fold(self, x, side):
        _, rows, columns = x.shape
        squares = x.reshape(rows // side, side, columns // side, side)
        return squares.transpose(1, 3, 0, 2).reshape(-1, rows // side, columns // side)

    def double(self, x):
        size = (2 * x.shape[2], 2 * x.shape[1])
        return np.stack([cv2.resize(channel, size) for channel in x])


def test_wrong_weights_and_sizes_are_refused_by_name(tmp_path):
    shape = SHAPES["lark"]
    weights = training_models.weights(shape)
    missing = {k: v for k, v in weights.items() if k != "fuse.norm.var"}
    with pytest.raises(TrainingError, match=r"lack 'fuse\.norm\.var'"):
        export.export(shape, missing, tmp_path / "x.onnx", "a test")
    weights["stem.weight"] = weights["stem.weight"][:, :, :2]
    with pytest.raises(TrainingError, match=r"'stem\.weight' is \(32, 16, 2, 3\)"):
        export.export(shape, weights, tmp_path / "x.onnx", "a test")
    assert not (tmp_path / "x.onnx").exists()
    with pytest.raises(TrainingError, match="size is 'tiny'; there are: lark"):
        shape_of("tiny")
