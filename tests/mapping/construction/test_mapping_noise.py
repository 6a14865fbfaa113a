"""How exactly key points fit is measured on a build's own images."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.mapping.construction import noise
from ground_station.mapping.construction.images import Images


def _images(sigma_px: float, count: int = 8, points: int = 300) -> Images:
    """A camera that steps sideways past points; each has a descriptor of its own."""
    rng = np.random.default_rng(3)
    world = rng.uniform([-3, -2, 3], [3, 2, 7], (points, 3))
    descriptor = rng.normal(size=(points, 64)).astype(np.float32)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    features = []
    for k in range(count):
        wTc = poses.exp(np.array([0, 0.02 * k, 0, 0.15 * k, 0.03 * np.sin(k), 0]))
        pixels = THESIS_CAMERA.project(poses.transform(poses.inverse(wTc), world))
        pixels += rng.normal(0, sigma_px, pixels.shape)
        seen = (pixels > 0).all(axis=1) & (pixels < [640, 480]).all(axis=1)
        features.append(
            Features(
                keypoints_px=pixels[seen].astype(np.float32),
                descriptors=descriptor[seen],
                scores=np.ones(np.count_nonzero(seen), np.float32),
            )
        )
    undistorted = [THESIS_CAMERA.undistort_to_pinhole(f.keypoints_px) for f in features]
    names = [f"{k:03d}" for k in range(count)]
    return Images(names, np.arange(count, dtype=np.int64) * 10**8, features, undistorted)


@pytest.mark.parametrize("sigma_px", [0.2, 0.5, 1.0])
def test_the_noise_of_key_points_is_found_and_its_limit_follows(sigma_px):
    found = noise.measured(_images(sigma_px), THESIS_CAMERA, 0.8)
    assert found is not None
    # Of a distance between two noisy points and a line through both, one coordinate each counts.
    assert sigma_px * 0.6 < found.sigma_px < sigma_px * 1.2
    assert 4 * sigma_px < found.limit_px < max(1.51, 12 * sigma_px)


def test_images_that_share_nothing_have_no_noise_that_one_could_measure():
    images = _images(0.3, count=2)
    rng = np.random.default_rng(0)
    other = rng.normal(size=images.features[1].descriptors.shape).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    images.features[1].descriptors[:] = other
    assert noise.measured(images, THESIS_CAMERA, 0.8) is None
