"""A model's file is refused in one line, naming it, before anything in it is run."""

from __future__ import annotations

import hashlib
import os

import made_up
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from ground_station.feature_models.graph import Graph
from ground_station.features import inspection
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import ModelInfo


@pytest.fixture
def path(tmp_path):
    return made_up.write_cells(
        tmp_path, made_up.info(threshold=0.01, nms_px=3, subpixel_px=2, distance_scale=1.5)
    )


def change(path, edit):
    proto = onnx.load_model(path)
    edit(proto)
    path.write_bytes(proto.SerializeToString())


def refused(path, reason):
    with pytest.raises(FeatureError, match=reason) as caught:
        inspection.read(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_what_was_written_is_read(path):
    found = inspection.read(path)
    assert found.info == made_up.info(threshold=0.01, nms_px=3, subpixel_px=2, distance_scale=1.5)
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert ModelInfo.of_metadata(found.info.metadata()) == found.info


def test_models_of_pixels_and_of_blobs_are_read(tmp_path):
    about = made_up.info(layout="pixels", multiple=32)
    assert inspection.read(made_up.write_pixels(tmp_path, about)).info == about
    about = made_up.info("spots", layout="blobs", details=6)
    path = made_up.write_blobs(tmp_path, about)
    assert inspection.read(path).info == about
    proto = onnx.load(path)
    for item in proto.metadata_props:
        if item.key == "blimp.details":
            item.value = "5"
    onnx.save(proto, path)
    with pytest.raises(FeatureError, match=r"'descriptors' has the shape 1x10x16x16"):
        inspection.read(path)
    with pytest.raises(FeatureError, match=r"details is 0; allowed: 1 to 15"):
        made_up.info(layout="blobs")
    with pytest.raises(FeatureError, match=r"details is 6; allowed: 0 to 0"):
        made_up.info(details=6)


@pytest.mark.parametrize(
    "key, value, reason",
    [
        ("blimp.schema", None, "lacks 'blimp.schema'"),
        ("blimp.schema", "blimp.features/2.0", "its schema is 'blimp.features/2.0'"),
        ("blimp.name", None, "lacks 'blimp.name'"),
        ("blimp.name", "../x", "name is '../x'"),
        ("blimp.layout", "voxels", "layout is 'voxels'; allowed: blobs, cells, pixels"),
        ("blimp.dimension", "many", "dimension is 'many', not a whole number"),
        ("blimp.dimension", "5000", "dimension is 5000; allowed: 2 to 1024"),
        ("blimp.dimension", "32", "'descriptors' has the shape 1x16x16x16"),
        ("blimp.multiple", "12", "multiple is 12; cells need a multiple of 8"),
        ("blimp.threshold", "nan", "threshold is nan"),
        ("blimp.threshold", "some", "threshold is 'some', not a number"),
        ("blimp.distance_scale", "nan", "distance_scale is nan"),
        ("blimp.distance_scale", "9", "distance_scale is 9.0; allowed: 0.25 to 4.0"),
        ("blimp.nms_px", "0", "nms_px is 0; allowed: 1 to 64"),
        ("blimp.licence", "a\nb", "licence must be one line"),
        ("blimp.source", "", "source must be one line"),
    ],
)
def test_metadata_that_are_lacking_or_no_models_are_refused(path, key, value, reason):
    def edit(proto):
        properties = {item.key: item.value for item in proto.metadata_props} | {key: value}
        helper.set_model_props(proto, {k: v for k, v in properties.items() if v is not None})

    change(path, edit)
    refused(path, reason)


def test_a_missing_a_foreign_a_cut_and_a_large_file_are_refused(path, tmp_path):
    refused(tmp_path / "none.onnx", "No such file")
    other = tmp_path / "other.onnx"
    for content in (b"", b"\x80\x04}q\x00.", b"not a model", bytes(1000)):
        other.write_bytes(content)
        refused(other, "not an ONNX file, or cut")
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        other.write_bytes(whole[: int(share * len(whole))])
        refused(other, ".")
    os.truncate(other, inspection.MAX_BYTES + 1)
    refused(other, "more than 64 MiB")


def test_values_in_another_file_are_refused(path):
    def edit(proto):
        tensor = proto.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="/etc/passwd")

    change(path, edit)
    refused(path, "values '.*' are in another file")


def add_node(operator, domain="", **attributes):
    def edit(proto):
        proto.graph.node.append(
            helper.make_node(operator, ["image"], ["more"], domain=domain, **attributes)
        )

    return edit


def own_domain(proto):
    proto.opset_import.append(helper.make_opsetid("com.example", 1))


def own_function(proto):
    node = helper.make_node("Relu", ["x"], ["y"])
    opset = [helper.make_opsetid("", 17)]
    proto.functions.append(helper.make_function("", "Mine", ["x"], ["y"], [node], opset))


def a_loop(proto):
    body = helper.make_graph([], "body", [], [])
    proto.graph.node.append(helper.make_node("Loop", ["image"], ["more"], body=body))


def a_hidden_graph(proto):
    body = helper.make_graph([], "body", [], [])
    proto.graph.node.append(helper.make_node("Relu", ["image"], ["more"], body=body))


@pytest.mark.parametrize(
    "edit, reason",
    [
        (own_domain, "operators of 'com.example'"),
        (own_function, "an operator of its own, 'Mine'"),
        (a_loop, "operator 'Loop'"),
        (a_hidden_graph, "holds another graph"),
        (add_node("PyOp", domain="ai.onnx.contrib"), "operator 'ai.onnx.contrib.PyOp'"),
        (add_node("RandomNormal", shape=[1 << 30]), "operator 'RandomNormal'"),
        (lambda proto: setattr(proto.opset_import[0], "version", 9), "are of set 9"),
        (lambda proto: proto.ClearField("opset_import"), "names no operator set"),
        (lambda proto: setattr(proto.graph.output[0], "name", "scores"), "its outputs are scores"),
        (lambda proto: proto.graph.input.append(proto.graph.output[0]), "its inputs are"),
        (
            lambda proto: setattr(proto.graph.node[0], "op_type", "Gelu"),
            "cannot be told beforehand",
        ),
        (add_node("MaxPool", kernel_shape=[3]), "does not fit together"),
    ],
)
def test_a_graph_that_is_no_feature_networks_is_refused(path, edit, reason):
    change(path, edit)
    refused(path, reason)


def graph_with(tmp_path, build):
    """A model of layout `cells` whose descriptors come by way of `build(graph, x)`."""
    about, rng = made_up.info(), np.random.default_rng(0)
    graph = Graph(about.name)
    x = graph.max_pool(graph.conv(graph.input("image", 1), made_up.drawn(rng, 16, 1, 3)), 8)
    graph.output(graph.conv(x, made_up.drawn(rng, 65, 16, 1)), "logits", 65)
    graph.output(build(graph, x), "descriptors", 16)
    path = tmp_path / "made-up.onnx"
    graph.save(path, about)
    return path


def test_arrays_that_would_exhaust_the_machine_are_refused(tmp_path):
    def build(graph, x):
        return graph.max_pool(graph.resize_bilinear(x, 64), 64)

    refused(graph_with(tmp_path, build), "values a pixel; at most 512")


def test_more_to_reckon_than_any_feature_network_has_is_refused(tmp_path):
    def build(graph, x):
        full = graph.resize_bilinear(x, 8)
        return graph.max_pool(graph.conv(full, np.zeros((16, 16, 91, 91), np.float32)), 8)

    path = graph_with(tmp_path, build)
    refused(path, "multiplications a pixel; at most")


def test_a_fixed_size_and_an_output_of_another_are_refused(path, tmp_path):
    def edit(proto):
        proto.graph.input[0].type.tensor_type.shape.dim[2].dim_value = 480

    change(path, edit)
    refused(path, "with N, H and W free")
    refused(graph_with(tmp_path, lambda graph, x: graph.max_pool(x, 2)), "1x16x8x8; the layout")


def test_what_a_network_takes_is_counted(tmp_path):
    path = made_up.write_cells(tmp_path, made_up.info(), widths=(8, 12, 16))
    found = inspection.read(path)
    pixels = 640 * 480
    expected = pixels * 9 * (8 + 8 * 12 / 4 + 12 * 16 / 16) + pixels / 64 * 16 * (65 + 16)
    assert inspection.macs(found.data, found.info) == pytest.approx(expected)


def test_flipped_bytes_are_read_or_refused_in_one_line(path):
    """Nothing but `FeatureError` comes of a damaged file, whatever onnx makes of it."""
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    refusals = 0
    for _ in range(250):
        broken = bytearray(whole)
        for place in rng.integers(0, len(whole), 3):
            broken[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(broken)
        try:
            inspection.read(path)
        except FeatureError as error:
            refusals += 1
            assert "\n" not in str(error) and len(str(error)) < 500
    # Most of the file is weights, of which any value is one.
    assert 10 < refusals < 250
