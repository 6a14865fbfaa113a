"""How far a model's descriptors are apart, beside RootSIFT's."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.feature_models.scale import distance_scale
from ground_station.features.extractor import Features
from ground_station.features.methods.orb import Orb
from ground_station.features.methods.rootsift import RootSift


class Turned(RootSift):
    """RootSIFT whose descriptors have components of their own in each picture."""

    def __init__(self, share: float, keep: int = 500) -> None:
        super().__init__(500)
        self._share, self._keep = share, keep
        self._rng = np.random.default_rng(0)

    def extract(self, image):
        found = super().extract(image)
        noise = self._rng.normal(size=(len(found), 64))
        noise *= self._share / np.linalg.norm(noise, axis=1, keepdims=True)
        longer = np.concatenate([found.descriptors, noise], axis=1).astype(np.float32)
        longer /= np.linalg.norm(longer, axis=1, keepdims=True)
        kept = slice(0, self._keep)
        return Features(found.keypoints_px[kept], found.scores[kept], longer[kept])


def test_rootsift_is_the_measure():
    assert distance_scale(RootSift(500, contrast_threshold=0.02)) == 1.0
    assert distance_scale(RootSift(500)) == pytest.approx(1.0, abs=0.015)


def test_descriptors_that_are_farther_apart_have_a_larger_scale():
    # Noise of 0.3 that no two views share adds 2 * 0.09 to the square of each distance: where
    # RootSIFT's far ones are 0.414 apart, these are sqrt((0.171 + 0.18) / 1.09), 1.37 times as far.
    assert distance_scale(Turned(0.3)) == pytest.approx(1.37, abs=0.08)
    assert distance_scale(Turned(0.6)) > 1.6


def test_orbs_is_the_measured_one():
    assert distance_scale(Orb(500)) == pytest.approx(Orb.distance_scale, abs=0.15)


def test_of_too_few_right_matches_nothing_is_said():
    assert distance_scale(Turned(0.6, keep=12)) == 1.0
