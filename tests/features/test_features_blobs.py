"""Blobs: where they are found, and that a network of layout `blobs` describes and ranks them."""

from __future__ import annotations

import cv2
import made_up
import numpy as np
import pytest
from reference import plain_superpoint

from ground_station.features import blobs, inspection
from ground_station.features.blobs import BlobFeatures
from ground_station.features.inference import Network
from ground_station.features.settings import LearnedSettings

Y, X = np.mgrid[:80, :100].astype(float)


def spots(points: list[tuple[float, float]], radius: float, step: float = 90) -> np.ndarray:
    picture = np.full(Y.shape, 120.0)
    for x, y in points:
        picture += step * np.exp(-((X - x) ** 2 + (Y - y) ** 2) / (2 * radius**2))
    return np.rint(picture.clip(0, 255)).astype(np.uint8)


@pytest.mark.parametrize("radius", [1.0, 2.0, 3.5])
@pytest.mark.parametrize("step", [90, -90])
def test_a_spot_is_found_where_it_is_to_a_fraction_of_a_pixel(radius, step):
    points = [(30.3, 20.6), (70.0, 50.5), (25.8, 61.1)]
    found, heights = blobs.strongest(blobs.responses(spots(points, radius, step)), 2, 9)
    assert (heights > 0.005).sum() == 3
    for point in points:
        assert np.linalg.norm(found - point, axis=1).min() < 0.1


def test_edges_ramps_and_flat_pictures_are_no_blobs():
    spot = max(level.max() for level in blobs.responses(spots([(50, 40)], 2, 90)))
    edge = np.rint(120 + 45 * np.tanh((X + 0.3 * Y - 60) / 1.5))
    for picture in (edge, 2 * X + 10):
        _, heights = blobs.strongest(blobs.responses(picture.astype(np.uint8)), 2, 100)
        assert heights.max(initial=0) < 0.1 * spot
    assert len(blobs.strongest(blobs.responses(np.full(Y.shape, 77, np.uint8)), 2, 9)[0]) == 0


def test_a_spot_counts_more_than_one_that_is_drawn_out():
    two = spots([(25.0, 40.0)], 2).astype(float)
    two += 90 * np.exp(-((X - 70) ** 2 / (2 * 2.0**2) + (Y - 40) ** 2 / (2 * 9.0**2)))
    found, heights = blobs.strongest(blobs.responses(two.clip(0, 255).astype(np.uint8)), 2, 9)
    spot = np.linalg.norm(found - (25, 40), axis=1) < 0.2
    assert spot.sum() == 1 and heights[spot][0] > 2 * heights[~spot].max(initial=0)


@pytest.mark.parametrize("radius", [1.2, 2.0, 3.0])
def test_a_spot_is_one_blob_whatever_its_size_and_where_a_camera_comes_nearer_it_stays(radius):
    dark = spots([(40.0, 40.0)], radius, -90) + 30 * np.sin(X / 9) * np.cos(Y / 11)
    for zoom in (1.0, 1.5):
        seen = cv2.resize(dark.astype(np.float32), None, fx=zoom, fy=zoom, interpolation=3)
        found, _ = blobs.strongest(blobs.responses(seen.clip(0, 255).astype(np.uint8)), 2, 50)
        at = (found + 0.5) / zoom - 0.5
        near = np.linalg.norm(at - 40, axis=1) < 3
        assert near.sum() == 1 and np.linalg.norm(at[near][0] - 40) < 0.3


def test_the_strongest_are_kept_apart_and_off_the_border():
    picture = np.random.default_rng(1).integers(0, 256, Y.shape).astype(np.uint8)
    values = blobs.responses(picture)
    found, heights = blobs.strongest(values, 3, 10_000)
    few, strong = blobs.strongest(values, 3, 40)
    assert len(found) > 40 and 30 < len(few) <= 40
    assert strong.min() >= np.sort(heights)[-40]
    one, _ = blobs.strongest(values[:1], 3, 10_000)
    apart = np.abs(one[:, None] - one[None]).max(axis=2) + 100 * np.eye(len(one))
    assert apart.min() > 4 - 2  # of their pixels; each moves by less than one
    edge = blobs.BORDER_PX - 1
    assert found.min() > edge and (found < np.array([100, 80]) - 1 - edge).all()


@pytest.fixture(scope="module")
def extractor(tmp_path_factory):
    about = made_up.info(layout="blobs", details=6)
    path = made_up.write_blobs(tmp_path_factory.mktemp("blobs"), about)
    return BlobFeatures(Network(inspection.read(path)), 30, LearnedSettings())


def test_blobs_are_described_and_ranked_by_what_the_network_says_of_the_padded_picture(extractor):
    rng = np.random.default_rng(2)
    image = cv2.resize(rng.integers(0, 256, (20, 27), dtype=np.uint8), (98, 77), None, 0, 0, 2)
    found = extractor.extract(image)
    edge = np.pad(image, ((0, 3), (0, 6)), mode="edge")
    said = extractor._network.run((edge / 255).astype(np.float32)[None, None])
    points, heights = blobs.strongest(blobs.responses(image), 2, 10_000)
    assert len(found) == 30 < len(points) and (np.diff(found.scores) <= 0).all()
    chance = np.empty(len(points))
    for k, (x, y) in enumerate(points):
        at = np.clip([(y - 3.5) / 8, (x - 3.5) / 8], 0, [8.999, 11.999])
        y0, x0 = at.astype(int)
        fy, fx = at - (y0, x0)
        square = said["worth"][0, 0, y0 : y0 + 2, x0 : x0 + 2]
        worth = np.array([1 - fy, fy]) @ square @ np.array([1 - fx, fx])
        chance[k] = 1 / (1 + np.exp(-(np.log(heights[k]) + worth)))
    order = np.argsort(-chance)[:30]
    assert found.scores == pytest.approx(chance[order], rel=1e-4)
    for k, place in enumerate(order):
        x, y = points[place]
        assert found.keypoints_px[k] == pytest.approx((x, y), abs=1e-3)
        parts = [
            plain_superpoint.descriptor(said["descriptors"][0], (x - 3.5) / 8, (y - 3.5) / 8),
            plain_superpoint.descriptor(said["details"][0], (x - 1.5) / 4, (y - 1.5) / 4),
        ]
        vector = np.concatenate(parts)
        assert np.allclose(found.descriptors[k], vector / np.linalg.norm(vector), atol=1e-4)


def test_outputs_that_are_not_finite_give_no_features_and_spoil_no_others(extractor):
    rng = np.random.default_rng(0)
    points = rng.uniform(8, 72, (200, 2)).astype(np.float32)
    heights = rng.uniform(0.001, 0.1, 200).astype(np.float32)
    said = {
        name: rng.normal(size=shape).astype(np.float32)
        for name, shape in (("worth", (1, 10, 10)), ("descriptors", (10, 10, 10)),
                            ("details", (6, 20, 20)))
    }  # fmt: skip
    said["worth"][:, :, :5] = np.nan
    said["details"][3, 10:] = np.inf
    found = extractor.of_outputs(points, heights, said)
    assert len(found) > 5
    assert found.keypoints_px[:, 0].min() > 35 and found.keypoints_px[:, 1].max() < 37
    assert np.isfinite(found.descriptors).all() and np.isfinite(found.scores).all()
    said["worth"][:] = -1e9  # no blob is worth anything
    assert len(extractor.of_outputs(points, heights, said)) == 0
