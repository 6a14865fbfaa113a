"""A learned extractor is its network's outputs and the papers' post-processing, end to end."""

from __future__ import annotations

import sys

import cv2
import made_up
import numpy as np
import onnx
import onnxruntime
import pytest
from reference import plain_alike, plain_superpoint

from ground_station.features import extractors, inference, inspection
from ground_station.features.extractor import FeatureError
from ground_station.features.inference import Network
from ground_station.features.learned import CellFeatures, PixelFeatures
from ground_station.features.settings import LearnedSettings


@pytest.fixture(scope="module")
def image():
    rng = np.random.default_rng(0)
    small = rng.integers(0, 256, (20, 27), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(small, (98, 77), interpolation=cv2.INTER_CUBIC), None, 1)


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    return inspection.read(made_up.write_cells(folder, made_up.info(subpixel_px=2)))


@pytest.fixture(scope="module")
def pixels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pixels")
    return inspection.read(made_up.write_pixels(folder, made_up.info(layout="pixels", multiple=32)))


def outputs(file, whole):
    session = onnxruntime.InferenceSession(file.data, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, {"image": whole}), strict=True))


def test_cells_are_superpoints_method_on_the_padded_picture(cells, image):
    extractor = CellFeatures(Network(cells), 60, LearnedSettings())
    found = extractor.extract(image)
    edge = np.pad(image, ((0, 3), (0, 6)), mode="edge")
    out = outputs(cells, (edge / 255).astype(np.float32)[None, None])
    scores = plain_superpoint.scores(out["logits"][0])[:77, :98]
    places = plain_superpoint.greedy(scores, 4, 0.015, 4, 60)
    assert len(found) == len(places) == 60
    for k, (row, column) in enumerate(places):
        x, y = plain_superpoint.expected_place(scores, row, column, 2)
        assert np.allclose(found.keypoints_px[k], [x, y], atol=1e-3)
        assert found.scores[k] == pytest.approx(scores[row, column], rel=1e-4)
        vector = plain_superpoint.descriptor(out["descriptors"][0], (x - 3.5) / 8, (y - 3.5) / 8)
        assert np.allclose(found.descriptors[k], vector / np.linalg.norm(vector), atol=1e-4)
    assert (extractor.name, extractor.dimension) == ("made-up", 16)
    assert extractor.sha256 == cells.sha256


def test_pixels_are_alikes_method_on_the_padded_picture(pixels, image):
    found = PixelFeatures(Network(pixels), 60, LearnedSettings()).extract(image)
    edge = np.pad(image, ((0, 19), (0, 30)), mode="edge")
    colour = np.repeat((edge / 255).astype(np.float32)[None, None], 3, axis=1)
    out = outputs(pixels, colour)
    scores = out["scores"][0, 0, :77, :98].astype(float)
    places = plain_superpoint.greedy(scores, 2, 0.2, 2, 60)
    assert len(found) == len(places) == 60
    for k, (row, column) in enumerate(places):
        x, y = plain_alike.soft_argmax(scores, row, column, 2, 0.1)
        assert np.allclose(found.keypoints_px[k], [x, y], atol=1e-3)
        vector = plain_alike.descriptor(out["descriptors"][0], x, y)
        assert np.allclose(found.descriptors[k], vector / np.linalg.norm(vector), atol=1e-3)


def test_what_the_model_says_counts_and_settings_count_more(tmp_path, image):
    about = made_up.info(nms_px=8, threshold=0.02)
    network = Network(inspection.read(made_up.write_cells(tmp_path, about)))
    own = CellFeatures(network, 500, LearnedSettings())
    assert (own.nms_px, own.threshold) == (8, 0.02)
    denser = CellFeatures(network, 500, LearnedSettings(nms_px=2, threshold=0.001))
    assert (denser.nms_px, denser.threshold) == (2, 0.001)
    found, more = own.extract(image), denser.extract(image)
    assert 5 < len(found) < len(more)
    apart = np.abs(found.keypoints_px[:, None] - found.keypoints_px[None]).max(axis=2)
    assert apart[~np.eye(len(found), dtype=bool)].min() > 8
    assert (found.keypoints_px % 1 == 0).all()  # without a window they stay on their pixels
    assert found.scores.min() > 0.02


def test_outputs_that_are_not_finite_give_no_features_and_spoil_no_others(cells):
    extractor = CellFeatures(Network(cells), 100, LearnedSettings())
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 4, (65, 10, 10)).astype(np.float32)
    descriptors = rng.normal(size=(16, 10, 10)).astype(np.float32)
    logits[:, :, :5] = np.nan
    descriptors[3, 5:] = np.inf
    found = extractor.of_outputs(logits, descriptors, (80, 80))
    assert len(found) > 5
    assert found.keypoints_px[:, 0].min() > 37 and found.keypoints_px[:, 1].max() < 37
    assert np.isfinite(found.descriptors).all() and np.isfinite(found.scores).all()


def test_scores_of_pixels_that_are_not_finite_give_no_features(pixels):
    extractor = PixelFeatures(Network(pixels), 100, LearnedSettings())
    rng = np.random.default_rng(0)
    scores = rng.random((60, 60)).astype(np.float32)
    scores[:30] = np.nan
    scores[30, 30] = np.inf
    found = extractor.of_outputs(scores, rng.normal(size=(8, 60, 60)).astype(np.float32), (60, 60))
    assert len(found) > 5 and found.keypoints_px[:, 1].min() > 27
    assert np.isfinite(found.keypoints_px).all() and found.scores.max() < 1


def test_weights_that_are_no_numbers_give_no_features(tmp_path, image):
    path = made_up.write_cells(tmp_path, made_up.info())
    proto = onnx.load_model(path)
    for tensor in proto.graph.initializer:
        tensor.raw_data = np.full(len(tensor.raw_data) // 4, np.nan, np.float32).tobytes()
    path.write_bytes(proto.SerializeToString())
    found = CellFeatures(Network(inspection.read(path)), 100, LearnedSettings()).extract(image)
    assert len(found) == 0


def test_a_picture_without_anything_has_no_features(tmp_path):
    network = Network(inspection.read(made_up.write_cells(tmp_path, made_up.info())))
    found = CellFeatures(network, 100, LearnedSettings(threshold=0.5)).extract(
        np.zeros((48, 64), np.uint8)
    )
    assert len(found) == 0 and found.descriptors.shape == (0, 16)
    assert found.keypoints_px.shape == (0, 2)


def test_a_picture_of_another_kind_is_refused(cells):
    extractor = CellFeatures(Network(cells), 100, LearnedSettings())
    for image in (np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64)), np.zeros((8, 64), np.uint8)):
        with pytest.raises(FeatureError, match="grey uint8 image"):
            extractor.extract(image)


def test_a_network_leaves_the_arithmetic_of_its_thread_as_it_was(cells):
    """Flushing small numbers to nought is the thread's, for good: a pose would change by it."""
    Network(cells)
    smallest = sys.float_info.min
    assert smallest / 2 > 0


def test_a_provider_that_is_not_installed_is_refused_with_those_that_are(cells):
    with pytest.raises(FeatureError, match=r"provider 'quantum' here \(there are: .*cpu"):
        Network(cells, "quantum")


def test_a_provider_that_cannot_run_here_is_refused_and_not_replaced(cells, monkeypatch):
    """onnxruntime itself goes on with its own kernels, and says so in a log."""
    monkeypatch.setattr(inference, "providers", lambda: {"cuda": "CUDAExecutionProvider"})
    with pytest.raises(FeatureError, match="'cuda' is installed but cannot run here"):
        Network(cells, "cuda")


def test_onnxruntimes_own_refusals_are_one_line(cells):
    with pytest.raises(FeatureError, match="onnxruntime failed") as caught:
        Network(cells).run(np.zeros((1, 3, 64, 64), np.float32))
    assert "\n" not in str(caught.value)


def test_one_core_is_left_to_the_tracker(monkeypatch):
    for cores, expected in ((1, 1), (2, 1), (4, 3), (64, 4)):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, n=cores: set(range(n)))
        assert inference.threads_beside_tracker() == expected


def test_the_threads_of_one_extractor_agree(tmp_path, monkeypatch, image):
    """One session serves map building's workers and the localizer's thread alike."""
    monkeypatch.setenv("BLIMP_MODELS", str(tmp_path))
    made_up.write_cells(tmp_path, made_up.info())
    first = extractors.create("made-up", 100).extract(image)
    second = extractors.create("made-up", 100, threads=2).extract(image)
    assert np.allclose(first.keypoints_px, second.keypoints_px)
    assert np.allclose(first.descriptors, second.descriptors, atol=1e-5)
