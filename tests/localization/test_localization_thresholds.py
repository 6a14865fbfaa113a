"""Descriptor limits: from the map's spread first, then from right and wrong matches."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ground_station.localization.settings import AssociationSettings
from ground_station.localization.thresholds import DescriptorThresholds

SETTINGS = AssociationSettings()
HIGHEST = SETTINGS.max_descriptor_distance


@pytest.fixture
def landmarks(room):
    spread = np.random.default_rng(1).uniform(0, 0.4, len(room.map.landmarks))
    return dataclasses.replace(room.map.landmarks, spread=spread.astype(np.float32))


def _fly(thresholds, rng, frames, true_rms, right_share):
    """Frames in which each landmark has its nearest feature at a distance, right or wrong."""
    for _ in range(frames):
        index = rng.permutation(4000)[:500]
        right = rng.random(500) < right_share[index]
        distance = np.abs(rng.normal(0, true_rms[index]))
        distance = np.where(right, distance, rng.normal(0.5, 0.06, 500)).astype(np.float32)
        pair = distance < thresholds.limits(index)
        thresholds.learn(index[pair], distance[pair], right[pair])


def test_before_anything_was_seen_the_limit_is_the_highest_for_all_but_the_steadiest(landmarks):
    limits = DescriptorThresholds(landmarks.spread, SETTINGS).limits(np.arange(4000))
    assert limits.dtype == np.float32 and limits.shape == (4000,)
    assert (limits <= np.float32(HIGHEST)).all() and limits.min() > HIGHEST - 0.1


def test_what_varied_more_in_the_map_may_be_farther(landmarks):
    thresholds = DescriptorThresholds(landmarks.spread, SETTINGS)
    thresholds.common = 0.4
    limits = thresholds.limits(np.arange(4000))
    order = np.argsort(landmarks.spread)
    assert (np.diff(limits[order]) >= 0).all()
    assert limits[order[-1]] > limits[order[0]] + 0.04


def test_learning_drops_wrong_pairs_and_keeps_right_ones(landmarks):
    rng = np.random.default_rng(2)
    rms, share = np.full(4000, 0.25), np.where(np.arange(4000) < 2000, 0.9, 0.03)
    thresholds = DescriptorThresholds(landmarks.spread, SETTINGS)
    _fly(thresholds, rng, 100, rms, share)
    good, poor = thresholds.limits(np.arange(2000)), thresholds.limits(np.arange(2000, 4000))
    assert good.mean() > poor.mean() + 0.1
    # Of wrong pairs, at 0.5 or so, most go; of right ones, few.
    assert np.mean(poor < 0.5) > 0.9
    assert np.mean(np.abs(rng.normal(0, 0.25, 2000)) < good) > 0.9


def test_in_other_light_all_limits_move(landmarks):
    rng = np.random.default_rng(3)
    share = np.full(4000, 0.4)
    thresholds = DescriptorThresholds(landmarks.spread, SETTINGS)
    _fly(thresholds, rng, 60, np.full(4000, 0.15), share)
    before = thresholds.common
    _fly(thresholds, rng, 60, np.full(4000, 0.4), share)
    assert before < 0.45 and thresholds.common > before + 0.03


def test_a_landmark_that_goes_wrong_is_believed_less_and_recovers(landmarks):
    thresholds = DescriptorThresholds(landmarks.spread, SETTINGS)
    thresholds.common = 0.4
    one, near = np.array([7]), np.array([0.2], np.float32)
    first = thresholds.limits(one)[0]
    other = thresholds.limits(np.array([8]))[0]
    for _ in range(10):
        thresholds.learn(one, near, np.array([False]))
    low = thresholds.limits(one)[0]
    for _ in range(40):
        thresholds.learn(one, near, np.array([True]))
    assert low < first - 0.05 and thresholds.limits(one)[0] > low + 0.1
    assert thresholds.limits(np.array([8]))[0] == other


def test_nothing_and_no_numbers_teach_nothing(landmarks):
    thresholds = DescriptorThresholds(landmarks.spread, SETTINGS)
    before, common = thresholds.limits(np.arange(4000)), thresholds.common
    none = np.empty(0, np.intp)
    thresholds.learn(none, np.empty(0, np.float32), np.empty(0, bool))
    nan = np.full(3, np.nan, np.float32)
    thresholds.learn(np.arange(3), nan, np.array([True, False, True]))
    assert thresholds.common == common and np.array_equal(
        thresholds.limits(np.arange(4000)), before
    )
    assert len(thresholds.limits(none)) == 0


def test_a_low_highest_distance_is_kept(landmarks):
    settings = AssociationSettings(max_descriptor_distance=0.2)
    thresholds = DescriptorThresholds(landmarks.spread, settings)
    _fly(thresholds, np.random.default_rng(4), 5, np.full(4000, 0.1), np.full(4000, 0.9))
    assert (thresholds.limits(np.arange(4000)) <= np.float32(0.2)).all()
