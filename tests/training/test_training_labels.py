"""Warps, labels and pairs: what training calls true must be."""

from dataclasses import replace

import numpy as np
import pytest

from ground_station.feature_models import images
from ground_station.features import detection
from ground_station.features.methods.rootsift import RootSift
from ground_station.training import pairs, validation, warps
from ground_station.training.corpus import Place

PICTURE, VIEW = (192, 256), (96, 128)


def spots(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Round spots at points (N, 2), a background in between."""
    y, x = np.mgrid[: size[0], : size[1]]
    result = np.full(size, 30.0)
    for px, py in points:
        result += 200 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 2.0**2))
    return result.clip(0, 255).astype(np.uint8)


def centre_near(picture: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The centre of what is bright within five pixels of a point."""
    x0, y0 = np.rint(point).astype(int)
    y, x = np.mgrid[y0 - 5 : y0 + 6, x0 - 5 : x0 + 6]
    weight = np.maximum(picture[y, x].astype(float) - 40, 0)
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def test_a_point_and_its_image_agree():
    rng = np.random.default_rng(0)
    at = np.stack(np.meshgrid([60, 100, 140, 190], [50, 90, 130]), axis=-1).reshape(-1, 2)
    picture = spots(at, PICTURE)
    checked = 0
    for _ in range(30):
        for matrix in warps.pair_of_views(rng, PICTURE, VIEW, warps.WarpLimits(tilt_deg=35)):
            view = pairs.view_of(picture, matrix, VIEW)
            there = warps.apply(np.linalg.inv(matrix), at)
            for point in there[warps.inside(there, VIEW, 8)]:
                assert centre_near(view, point) == pytest.approx(point, abs=0.45)
                checked += 1
    assert checked > 50


def test_a_plane_seen_straight_is_scaled_turned_and_shifted():
    straight = warps.of_plane(
        PICTURE, VIEW, centre_px=(100, 80), scale=2.0, roll_deg=90.0, tilt_deg=0.0,
        tilt_axis_deg=0.0,
    )  # fmt: skip
    middle = np.array([[(VIEW[1] - 1) / 2, (VIEW[0] - 1) / 2]])
    assert warps.apply(straight, middle) == pytest.approx(np.array([[100, 80]]))
    right = warps.apply(straight, middle + np.array([[10, 0]]))
    assert right == pytest.approx(np.array([[100, 100]]))  # turned clockwise in the picture
    tilted = warps.of_plane(
        PICTURE, VIEW, centre_px=(100, 80), scale=1.0, roll_deg=0.0, tilt_deg=40.0,
        tilt_axis_deg=90.0,
    )  # fmt: skip
    ends = warps.apply(tilted, middle + np.array([[-30, 0], [30, 0]]))
    steps = np.abs(ends[:, 0] - 100)
    assert max(steps) / min(steps) > 1.2  # one side is farther away
    assert warps.apply(tilted, middle) == pytest.approx(np.array([[100, 80]]))


def test_points_behind_the_horizon_are_nowhere():
    matrix = np.array([[1, 0, 0], [0, 1, 0], [0, -0.02, 1.0]])
    seen = warps.apply(matrix, np.array([[10.0, 10.0], [10.0, 90.0]]))
    assert np.isfinite(seen[0]).all() and np.isnan(seen[1]).all()
    assert warps.inside(seen, (100, 100)).tolist() == [True, False]


def test_cells_are_distributions_and_keep_a_points_fraction_of_a_pixel():
    points = np.array([[10.25, 20.5], [40.0, 7.9], [3.0, 3.0], [-5.0, 2.0]], np.float32)
    chances = np.array([1, 0.8, 0.4, 1], np.float32)
    made = pairs.soft_cells(points, chances, (48, 64))
    assert made.shape == (65, 6, 8) and made.min() >= 0
    assert made.sum(axis=0) == pytest.approx(np.ones((6, 8)))
    mass = made[:64].reshape(8, 8, 6, 8).transpose(2, 0, 3, 1).reshape(48, 64)
    y, x = np.mgrid[:48, :64]
    for point, chance in zip(points[:3], chances[:3], strict=True):
        near = np.hypot(x - point[0], y - point[1]) < 3
        assert mass[near].sum() == pytest.approx(chance)
        assert (mass * near * x).sum() / chance == pytest.approx(point[0], abs=1e-4)
        assert (mass * near * y).sum() / chance == pytest.approx(point[1], abs=1e-4)
    assert mass.sum() == pytest.approx(2.2, abs=1e-4)
    crowd = pairs.soft_cells(
        np.array([[2, 2], [5, 5], [2, 5]], np.float32), np.ones(3, np.float32), (16, 16)
    )
    assert crowd[:64, 0, 0].sum() == pytest.approx(1) and crowd[64, 0, 0] == 0


def test_the_extractor_reads_from_perfect_logits_where_the_points_are():
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.arange(12, 110, 13), np.arange(12, 80, 13)), axis=-1)
    points = (grid.reshape(-1, 2) + rng.uniform(-2, 2, (grid[..., 0].size, 2))).astype(np.float32)
    made = pairs.soft_cells(points, np.ones(len(points), np.float32), VIEW)
    scores = detection.cell_scores(np.log(np.maximum(made, 1e-6)))
    rows, columns = detection.strongest(scores, radius_px=3, threshold=0.02, border_px=4, most=1000)
    found = detection.refined(scores, rows, columns, radius_px=1)
    gaps = np.linalg.norm(points[:, None] - found[None], axis=2).min(axis=1)
    assert np.median(gaps) < 0.15 and (gaps < 1).mean() > 0.97


def place(rng: np.random.Generator) -> Place:
    picture = images.procedural(9, 2, PICTURE)
    points = rng.uniform(5, 180, (80, 2)).astype(np.float32)
    vectors = rng.standard_normal((80, 8)).astype(np.float16)
    return Place(np.stack([picture, 255 - picture]), points, np.linspace(0.6, 0.06, 80), vectors)


def test_a_pair_has_fixed_shapes_and_true_correspondences():
    rng = np.random.default_rng(5)
    one = place(rng)
    counts = []
    for _ in range(12):
        pair = pairs.make_pair(one, rng, VIEW, 48)
        assert pair.images.shape == (2, *VIEW) and pair.labels.shape == (2, 65, 12, 16)
        assert pair.points_px.shape == (2, 48, 2) and pair.teacher.shape == (48, 8)
        n = int(pair.used.sum())
        counts.append(n)
        assert pair.used[:n].all()
        moved = warps.apply(pair.second_from_first, pair.points_px[0, :n])
        assert moved == pytest.approx(pair.points_px[1, :n], abs=1e-2)
        assert warps.inside(pair.points_px[1, :n], VIEW, 3.9).all()
        assert pair.labels.sum(axis=1) == pytest.approx(np.ones((2, 12, 16)), abs=2e-3)
        assert pair.known.any()
    assert np.mean(counts) > 24


def test_the_same_step_gives_the_same_pair():
    corpus = [place(np.random.default_rng(6))]
    source = pairs.PairSource(corpus, 3, VIEW, 32)  # type: ignore[arg-type]
    first, again, other = source.pair(7, 1), source.pair(7, 1), source.pair(8, 1)
    assert all((getattr(first, k) == getattr(again, k)).all() for k in vars(first))
    assert (first.images != other.images).any()


def test_the_figures_of_validation_are_those_of_the_truth():
    one = place(np.random.default_rng(6))
    pair = pairs.make_pair(one, np.random.default_rng(7), VIEW, 32)
    size = (120, 160)
    picture = images.procedural(9, 2, size)
    shifted = np.roll(picture, (4, -6), axis=(0, 1))
    matrix = np.array([[1, 0, -6], [0, 1, 4], [0, 0, 1.0]])
    pair = replace(pair, images=np.stack([picture, shifted]), second_from_first=matrix)
    right = validation.figures(RootSift(200), [pair])
    assert right.accuracy > 0.9 and right.repeatability > 0.8 and right.correct > 20
    assert right.error_px < 0.1
    # A truth that is wrong by 20 px makes all of it chance.
    wrong = replace(pair, second_from_first=matrix + np.array([[0, 0, 20], [0, 0, 0], [0, 0, 0]]))
    chance = validation.figures(RootSift(200), [wrong])
    assert chance.accuracy < 0.2 and chance.error_px > 0.5
