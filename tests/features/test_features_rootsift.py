"""RootSIFT is SIFT with the Hellinger kernel, through the interface of all extractors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ground_station.features import extractors
from ground_station.features.extractor import FeatureError
from ground_station.features.methods.rootsift import hellinger


def test_descriptors_are_the_square_roots_of_opencvs_normalised_histograms(picture):
    found = extractors.create("rootsift", 300).extract(picture)
    sift = cv2.SIFT.create(
        nfeatures=300, contrastThreshold=0.006, edgeThreshold=10, enable_precise_upscale=True
    )
    keypoints, histograms = sift.detectAndCompute(picture, None)
    expected = np.sqrt(histograms / histograms.sum(axis=1, keepdims=True))
    by_place = {}
    for keypoint, vector in zip(keypoints, expected, strict=True):
        by_place.setdefault(keypoint.pt, []).append(vector)
    assert 250 < len(found) <= 300
    for pixel, vector in zip(found.keypoints_px.tolist(), found.descriptors, strict=True):
        near = [np.abs(vector - other).max() for other in by_place[tuple(pixel)]]
        assert min(near) < 1e-6


def test_descriptors_have_unit_norm_and_the_strongest_come_first(picture):
    found = extractors.create("rootsift", 200).extract(picture)
    assert found.descriptors.shape == (len(found), 128)
    assert found.descriptors.dtype == found.keypoints_px.dtype == np.float32
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    assert (np.diff(found.scores) <= 0).all()


def test_a_faint_wall_has_features_that_are_found_again_beside_the_sensors_noise(picture):
    wall = 120 + 0.05 * (picture.astype(float) - 128)  # a few grey levels of texture
    noise = np.random.default_rng(1)
    extractor = extractors.create("rootsift", 300)
    first, second = (
        extractor.extract((wall + noise.normal(0, 1.0, wall.shape)).round().astype(np.uint8))
        for _ in range(2)
    )
    assert min(len(first), len(second)) > 200
    apart = np.linalg.norm(first.keypoints_px[:, None] - second.keypoints_px[None], axis=2)
    assert np.median(apart.min(axis=1)) < 1.0


def test_the_same_picture_gives_the_same_features(picture):
    first, second = (extractors.create("rootsift", 200).extract(picture) for _ in range(2))
    assert np.array_equal(first.keypoints_px, second.keypoints_px)
    assert np.array_equal(first.descriptors, second.descriptors)


def test_key_points_count_from_the_centre_of_the_first_pixel():
    image = np.zeros((101, 101), np.uint8)
    cv2.circle(image, (50, 50), 8, 255, -1)
    found = extractors.create("rootsift", 10).extract(cv2.GaussianBlur(image, None, 1.5))
    assert np.linalg.norm(found.keypoints_px[0] - [50, 50]) < 0.1


@pytest.mark.parametrize(("method", "dimension"), [("rootsift", 128), ("orb", 256)])
def test_a_picture_without_texture_has_no_features(method, dimension):
    found = extractors.create(method).extract(np.full((480, 640), 128, np.uint8))
    assert len(found) == 0 and found.descriptors.shape == (0, dimension)


def test_an_empty_histogram_stays_finite():
    assert np.isfinite(hellinger(np.zeros((2, 128), np.float32))).all()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((480, 640), np.float32),
        np.zeros((8, 640), np.uint8),
        np.zeros((0, 0), np.uint8),
    ],
)
def test_images_of_another_kind_are_refused(image):
    with pytest.raises(FeatureError, match="grey uint8 image"):
        extractors.create("rootsift").extract(image)


def test_the_model_is_told_apart_by_its_hash():
    first = extractors.create("rootsift", 100)
    assert first.sha256 == extractors.create("rootsift", 200).sha256
    assert len(first.sha256) == 64 and first.dimension == 128
