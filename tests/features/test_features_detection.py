"""Key points are those of the papers, reckoned in plain loops beside."""

from __future__ import annotations

import numpy as np
import pytest
from reference import plain_alike, plain_superpoint

from ground_station.features import detection


def test_scores_are_a_softmax_over_each_cell_laid_out_pixel_by_pixel():
    logits = np.random.default_rng(0).normal(0, 5, (65, 4, 6)).astype(np.float32)
    found = detection.cell_scores(logits)
    assert found.shape == (32, 48) and found.dtype == np.float32
    assert np.allclose(found, plain_superpoint.scores(logits), atol=1e-6)


def test_a_cell_with_logits_that_are_not_finite_scores_nothing_and_the_others_as_ever():
    logits = np.random.default_rng(0).normal(0, 5, (65, 3, 3)).astype(np.float32)
    broken = logits.copy()
    broken[7, 0, 0], broken[64, 1, 1], broken[3, 2, 2] = np.nan, np.inf, -np.inf
    found, expected = detection.cell_scores(broken), detection.cell_scores(logits)
    assert (found[:8, :8] == 0).all() and (found[8:16, 8:16] == 0).all()
    assert np.isfinite(found).all()
    # A logit of minus infinity is a chance of nought, which is a number.
    assert found[16, 19] == 0 and found[16:, 16:].sum() > 0
    assert np.array_equal(found[:8, 8:], expected[:8, 8:])


def spread(name: str) -> np.ndarray:
    """Scores of several kinds (60, 90), no two above 0 alike."""
    rng = np.random.default_rng(1)
    if name == "a ramp, where each point is suppressed by its neighbour":
        return (np.arange(60 * 90).reshape(60, 90) / 5400).astype(np.float32)
    scores = rng.random((60, 90)).astype(np.float32)
    if name == "spikes":
        scores *= rng.random((60, 90)) < 0.02
    return scores


@pytest.mark.parametrize(
    "name", ["noise", "spikes", "a ramp, where each point is suppressed by its neighbour"]
)
@pytest.mark.parametrize("radius, border, most", [(4, 4, 1000), (4, 0, 7), (1, 4, 50), (12, 3, 5)])
def test_suppression_is_the_greedy_one(name, radius, border, most):
    scores = spread(name)
    rows, columns = detection.strongest(
        scores, radius_px=radius, threshold=0.3, border_px=border, most=most
    )
    expected = plain_superpoint.greedy(scores, radius, 0.3, border, most)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    assert expected


@pytest.mark.parametrize("levels", [1, 3, 8])
def test_of_equal_scores_one_is_kept_and_none_is_forgotten(levels):
    """As of a quantised network: each point above the threshold is kept or beside a kept one that
    is no weaker, and no two kept ones are neighbours."""
    noise = np.random.default_rng(1).random((60, 90))
    scores = (np.ceil(noise * levels) / levels).astype(np.float32)
    radius = 4
    rows, columns = detection.strongest(
        scores, radius_px=radius, threshold=0.3, border_px=0, most=10_000
    )
    kept, covered = np.zeros_like(scores, bool), np.zeros_like(scores)
    for row, column in zip(rows, columns, strict=True):
        window = np.s_[max(0, row - radius) : row + radius + 1,
                       max(0, column - radius) : column + radius + 1]  # fmt: skip
        assert not kept[window].any()
        kept[row, column] = True
        covered[window] = np.maximum(covered[window], scores[row, column])
    assert (covered >= np.where(scores > 0.3, scores, 0)).all()


def test_nothing_above_the_threshold_gives_nothing():
    none = np.zeros((60, 90), np.float32)
    rows, columns = detection.strongest(none, radius_px=4, threshold=0, border_px=4, most=9)
    assert len(rows) == len(columns) == 0


def test_the_threshold_is_a_score_that_is_not_enough():
    scores = np.zeros((40, 40), np.float32)
    scores[10, 10], scores[30, 30] = 0.25, np.nextafter(np.float32(0.25), np.float32(1))
    rows, _ = detection.strongest(scores, radius_px=4, threshold=0.25, border_px=4, most=10)
    assert rows.tolist() == [30]


def test_a_part_of_a_larger_array_is_taken_as_it_is():
    scores = np.random.default_rng(2).random((50, 70)).astype(np.float32)
    part, whole = scores[:40, :60], np.ascontiguousarray(scores[:40, :60])
    given = {"radius_px": 3, "threshold": 0.5, "border_px": 4, "most": 100}
    for first, second in zip(
        detection.strongest(part, **given), detection.strongest(whole, **given), strict=True
    ):
        assert np.array_equal(first, second)


def test_a_key_point_moves_to_where_its_scores_expect_it():
    scores = np.random.default_rng(3).random((30, 40)).astype(np.float32)
    rows, columns = np.array([0, 12, 29]), np.array([1, 20, 39])
    found = detection.refined(scores, rows, columns, radius_px=2)
    for point, row, column in zip(found, rows, columns, strict=True):
        assert np.allclose(
            point, plain_superpoint.expected_place(scores, row, column, 2), atol=1e-5
        )


def test_the_soft_argmax_is_alikes():
    scores = np.random.default_rng(4).random((30, 40)).astype(np.float32)
    rows, columns = np.array([2, 12, 27]), np.array([2, 20, 37])
    found = detection.refined(scores, rows, columns, radius_px=2, temperature=0.1)
    for point, row, column in zip(found, rows, columns, strict=True):
        expected = plain_alike.soft_argmax(scores, row, column, 2, 0.1)
        assert np.allclose(point, expected, atol=1e-5)


def test_a_blob_between_pixels_is_found_there():
    y, x = np.mgrid[:40, :40]
    for at in ((20.0, 17.3), (19.6, 18.25)):
        blob = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 0.7**2)).astype(np.float32)
        rows, columns = detection.strongest(blob, radius_px=4, threshold=0.1, border_px=4, most=10)
        assert len(rows) == 1
        found = detection.refined(blob, rows, columns, radius_px=2)
        assert np.linalg.norm(found[0] - at) < 0.01


def test_without_a_window_key_points_stay_on_their_pixels():
    scores = np.ones((9, 9), np.float32)
    found = detection.refined(scores, np.array([3]), np.array([5]), radius_px=0)
    assert found.tolist() == [[5.0, 3.0]]
    none = np.empty(0, np.intp)
    assert detection.refined(scores, none, none, radius_px=2).shape == (0, 2)
