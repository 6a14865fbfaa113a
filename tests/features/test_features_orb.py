"""ORB's bits as unit vectors: the order by L2 is the order by Hamming distance."""

from __future__ import annotations

import cv2
import numpy as np

from ground_station.features import extractors
from ground_station.features.methods.orb import unit_of_bits
from ground_station.mapping.construction.matching import mutual_matches


def test_squared_distances_are_hamming_distances_over_a_quarter_of_the_bits():
    bits = np.random.default_rng(0).integers(0, 256, (60, 32), dtype=np.uint8)
    vectors = unit_of_bits(bits)
    hamming = np.unpackbits(bits[:, None] ^ bits[None], axis=2).sum(axis=2)
    apart = ((vectors[:, None] - vectors[None]) ** 2).sum(axis=2)
    assert np.allclose(apart, hamming / 64, atol=1e-5)
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1)


def test_they_are_opencvs_strongest_first(picture):
    found = extractors.create("orb", 300).extract(picture)
    keypoints, bits = cv2.ORB.create(nfeatures=300).detectAndCompute(picture, None)
    assert 250 < len(found) <= 300 and found.descriptors.shape == (len(found), 256)
    assert (np.diff(found.scores) <= 0).all()
    theirs = {row.tobytes() for row in unit_of_bits(bits)}
    assert all(row.tobytes() in theirs for row in found.descriptors)
    assert len(keypoints) >= len(found)


def test_key_points_of_coarse_levels_count_from_the_centre_of_the_first_pixel(picture):
    """Turned upside down, a point at (x, y) is one at (639 - x, 479 - y) with the same bits."""
    turned = np.ascontiguousarray(picture[::-1, ::-1])
    first, second = (extractors.create("orb", 1500).extract(i) for i in (picture, turned))
    pairs = mutual_matches(first.descriptors, second.descriptors, 0.9)
    there, back = first.keypoints_px[pairs[:, 0]], second.keypoints_px[pairs[:, 1]]
    apart = there + back - [639, 479]
    apart = apart[np.abs(apart).max(axis=1) < 4]
    assert len(apart) > 300
    assert np.abs(apart.mean(axis=0)).max() < 0.1
