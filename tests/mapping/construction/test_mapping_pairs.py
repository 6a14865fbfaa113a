"""Neighbours are of one input, look-alikes are found, and a second round closes what links show."""

from __future__ import annotations

import tracemalloc

import numpy as np

from ground_station.mapping.construction import pairs as pairs_module
from ground_station.mapping.construction.pairs import (
    choose_pairs,
    covisible_pairs,
    reduced_vlad,
    sequences,
    steps,
    vlad,
)
from ground_station.mapping.settings import MatchSettings

RNG = np.random.default_rng(5)


def _unit(values):
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


def _images(n):
    return [_unit(RNG.normal(size=(30, 16))) for _ in range(n)]


def test_another_input_or_time_that_falls_back_begins_another_sequence():
    names = ["a/0", "a/1", "b/0", "b/1", "b/2"]
    assert sequences(names, np.arange(5) * 100).tolist() == [0, 0, 1, 1, 1]
    assert sequences(["0", "1", "2"], np.array([0, 5, 5])).tolist() == [0, 0, 0]
    assert sequences(["0", "1", "2"], np.array([0, 5, 2])).tolist() == [0, 0, 1]
    # A camera that stood still for an hour is still where it was.
    assert sequences(["0", "1", "2"], np.array([0, 5, 3_600_000_000_000])).tolist() == [0, 0, 0]
    assert sequences(["0"], np.array([7])).tolist() == [0]


def test_neighbours_are_of_one_sequence():
    settings = MatchSettings(exhaustive_max=2, neighbours=2, similar=0)
    pairs = choose_pairs(_images(7), settings, 0, np.array([0, 0, 0, 1, 1, 1, 1]))
    assert pairs == [(0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5), (4, 6), (5, 6)]


def test_far_neighbours_are_compared_ever_more_rarely():
    assert [steps(reach) for reach in (1, 2, 5)] == [[1], [1, 2], [1, 2, 3, 4]]
    assert steps(30) == [1, 2, 3, 4, 6, 8, 12, 16, 24]
    settings = MatchSettings(exhaustive_max=2, neighbours=7, similar=0)
    pairs = choose_pairs(_images(12), settings, 0)
    assert {j - i for i, j in pairs} == {1, 2, 3, 4, 6}
    assert [j for i, j in pairs if i == 2] == [3, 4, 5, 6, 8]


def test_images_of_two_inputs_that_look_alike_are_compared():
    places = _images(6)
    again = [_unit(p + 0.05 * RNG.normal(size=p.shape)) for p in places]
    settings = MatchSettings(exhaustive_max=2, neighbours=1, similar=1)
    pairs = choose_pairs(places + again, settings, 0, np.repeat([0, 1], 6))
    assert {(k, k + 6) for k in range(6)} <= set(pairs)
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs) and len(pairs) <= 12 * 2
    assert pairs == choose_pairs(places + again, settings, 0, np.repeat([0, 1], 6))
    # The end of one and the beginning of the other are compared only if they look alike.
    unlike = choose_pairs(_images(4), MatchSettings(exhaustive_max=2, neighbours=1, similar=0), 0,
                          np.array([0, 0, 1, 1]))  # fmt: skip
    assert unlike == [(0, 1), (2, 3)]


def test_every_pair_is_compared_by_choice_and_of_few_images():
    images = _images(9)
    for settings in (MatchSettings(pairs="exhaustive", exhaustive_max=2), MatchSettings()):
        chosen = choose_pairs(images, settings, 0)
        assert chosen == [(i, j) for i in range(9) for j in range(i + 1, 9)]


def test_images_without_features_are_like_nothing():
    dark = [np.empty((0, 16), np.float32)] * 5
    assert not vlad(dark, 0).any()
    settings = MatchSettings(exhaustive_max=2, neighbours=1, similar=2)
    assert {(k, k + 1) for k in range(4)} <= set(choose_pairs(dark, settings, 0))
    some = vlad([*_images(3), *dark], 0)
    assert np.allclose(np.linalg.norm(some, axis=1), [1, 1, 1, 0, 0, 0, 0, 0], atol=1e-5)


def _links(*links):
    return {(i, j): matches for i, j, matches in links}


def test_images_that_a_third_one_has_seen_are_compared_next():
    settings = MatchSettings(min_inliers_far=30, covisible=5)
    linked = _links((0, 1, 80), (1, 2, 60), (2, 3, 20))  # the last link is weak
    assert covisible_pairs(5, [*linked, (0, 4)], linked, settings) == [(0, 2)]
    # What was tried and failed is not tried again.
    assert covisible_pairs(5, [*linked, (0, 2)], linked, settings) == []
    assert covisible_pairs(4, [], {}, settings) == []


def test_each_image_takes_those_with_the_strongest_links_in_common():
    # 0 is linked to 1 and 2; 3 to both, 4 strongly to one, 5 weakly to one.
    linked = _links((0, 1, 90), (0, 2, 90), (1, 3, 50), (2, 3, 50), (1, 4, 80), (2, 5, 35))

    def of_first(most):
        settings = MatchSettings(min_inliers_far=30, covisible=most)
        pairs = covisible_pairs(6, list(linked), linked, settings)
        assert all(i < j for i, j in pairs) and not set(pairs) & set(linked)
        return pairs

    assert (0, 3) in of_first(1)  # 50 + 50
    assert {(0, 3), (0, 4)} <= set(of_first(2))
    assert {(0, 3), (0, 4), (0, 5)} <= set(of_first(3))


def test_the_second_round_is_bounded():
    # A hub that sees everything would bring every pair.
    n = 60
    linked = {(0, j): 50 + j for j in range(1, n)}
    settings = MatchSettings(min_inliers_far=30, covisible=3)
    pairs = covisible_pairs(n, list(linked), linked, settings)
    assert 0 < len(pairs) <= 3 * n
    assert pairs == sorted(set(pairs))


def test_of_many_images_an_index_finds_those_that_look_alike(monkeypatch):
    monkeypatch.setattr(pairs_module, "_COMPARED_WHOLE", 50)
    places = _images(120)
    again = [_unit(p + 0.05 * RNG.normal(size=p.shape)) for p in places]
    settings = MatchSettings(exhaustive_max=2, neighbours=2, similar=3)
    way = np.repeat([0, 1], 120)
    pairs = choose_pairs(places + again, settings, 0, way)
    assert {(k, k + 120) for k in range(120)} <= set(pairs)
    assert {(k, k + 1) for k in range(239) if k != 119} <= set(pairs)
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs)
    assert len(pairs) <= 240 * (3 + 2)
    assert pairs == choose_pairs(places + again, settings, 0, way)


def test_reduced_vectors_are_of_unit_length_and_keep_what_is_alike():
    places = _images(40)
    again = [_unit(p + 0.05 * RNG.normal(size=p.shape)) for p in places]
    vectors = reduced_vlad(places + again, 0)
    assert vectors.shape[0] == 80 and vectors.shape[1] <= 80
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -1)
    assert similarity.argmax(axis=1).tolist() == [*range(40, 80), *range(40)]


def test_memory_grows_with_the_images_and_not_with_their_square():
    n = 6000
    images = [np.empty((0, 16), np.float32)] * n
    linked = {(i, i + step): 50 for step in (1, 2) for i in range(n - step)}
    settings = MatchSettings(min_inliers_far=30, covisible=4, similar=0)
    tracemalloc.start()
    try:
        chosen = choose_pairs(images, settings, 0)
        more = covisible_pairs(n, list(linked), linked, settings)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # A matrix of all pairs has 36 MB where each is a byte.
    assert len(chosen) > n and len(more) > n and peak < 36e6
