"""Expected blur is the path in the image; blurred frames say less, and never more."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization.blur import (
    blurred_sigma_px,
    expected_blur_px,
    gradient_energy,
    sharpness,
)
from ground_station.localization.settings import BlurSettings

CAMERA = THESIS_CAMERA
TWIST = np.array([0.3, -0.7, 0.5, 1.5, -0.4, 2.0])


def points(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    flat = rng.uniform([-0.5, -0.4], [0.5, 0.4], (count, 2))
    return np.c_[flat, np.ones(count)] * rng.uniform(1, 9, (count, 1))


def textured(seed: int = 4) -> np.ndarray:
    """A picture of edges and faint texture, as walls have, with a sensor's noise."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.integers(30, 220, (24, 32), dtype=np.uint8), (640, 480),
                        interpolation=cv2.INTER_NEAREST)  # fmt: skip
    fine = cv2.GaussianBlur(rng.normal(0, 60, (480, 640)).astype(np.float32), (0, 0), 2)
    return np.clip(coarse + fine + rng.normal(0, 2, (480, 640)), 0, 255).astype(np.uint8)


def smeared(image: np.ndarray, length_px: int) -> np.ndarray:
    kernel = np.full((1, length_px), 1 / length_px, np.float32)
    return np.asarray(cv2.filter2D(image, -1, kernel), np.uint8)


def test_expected_blur_is_the_length_of_the_path_through_many_instants() -> None:
    exposure_s, seen = 0.016, points()
    instants = np.linspace(-exposure_s / 2, exposure_s / 2, 101)
    # The camera at t has the pose exp(twist t) in its axes of the middle.
    path = [
        CAMERA.project(poses.transform(poses.inverse(poses.exp(TWIST * t)), seen)) for t in instants
    ]
    length = np.linalg.norm(np.diff(path, axis=0), axis=2).sum(axis=0)
    assert length.max() > 8
    np.testing.assert_allclose(
        expected_blur_px(CAMERA, seen, TWIST, exposure_s), length, rtol=0.02, atol=0.02
    )


def test_turning_smears_alike_at_every_distance_and_moving_the_near_more() -> None:
    ray = np.array([[0.1, 0.05, 1.0]])
    near, far = ray, 10 * ray
    turn, move = [0, 1.0, 0, 0, 0, 0], [0, 0, 0, 1.0, 0, 0]
    blur = {
        (name, k): float(expected_blur_px(CAMERA, p, twist, 0.01)[0])
        for name, twist in (("turn", turn), ("move", move))
        for k, p in (("near", near), ("far", far))
    }
    assert blur["turn", "near"] == pytest.approx(blur["turn", "far"])
    assert blur["turn", "near"] == pytest.approx(0.01 * CAMERA.fx_px, rel=0.1)
    assert blur["move", "near"] == pytest.approx(10 * blur["move", "far"], rel=1e-3)


def test_an_unknown_exposure_expects_no_blur_and_what_is_behind_has_none() -> None:
    assert (expected_blur_px(CAMERA, points(5), TWIST, None) == 0).all()
    assert expected_blur_px(CAMERA, np.empty((0, 3)), TWIST, 0.01).shape == (0,)
    mixed = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 0.0], [np.nan, 0, 1.0]])
    blur = expected_blur_px(CAMERA, mixed, TWIST, 0.01)
    assert np.isfinite(blur[0]) and np.isnan(blur[1:]).all()


def test_blur_lowers_the_energy_and_light_and_noise_hardly_change_it() -> None:
    image = textured()
    energies = [gradient_energy(smeared(image, n)) for n in (1, 5, 9, 17, 31)]
    assert all(after < 0.95 * before for before, after in pairwise(energies))
    darker = (image * 0.5).astype(np.uint8)
    assert gradient_energy(darker) == pytest.approx(energies[0], rel=0.02)
    noise = np.random.default_rng(1).normal(0, 5, image.shape)
    noisy = np.clip(image + noise, 0, 255).astype(np.uint8)
    assert gradient_energy(noisy) == pytest.approx(energies[0], rel=0.15)


@pytest.mark.parametrize("shape", [(480, 640), (1, 1), (3, 900)])
def test_a_picture_without_contrast_has_no_energy(shape: tuple[int, int]) -> None:
    assert gradient_energy(np.full(shape, 90, np.uint8)) == 0.0


def test_sharpness_is_relative_to_the_recent_median_and_bounded() -> None:
    assert sharpness(1.0, [4.0, 4.0, 400.0]) == pytest.approx(0.5)
    assert sharpness(9.0, [4.0]) == 1.0
    assert sharpness(1.0, []) == sharpness(1.0, [np.nan, 0.0]) == sharpness(np.nan, [1.0]) == 1.0
    assert 0 < sharpness(0.0, [1.0]) == sharpness(-1.0, [1.0]) < 0.1


def test_sigma_grows_with_blur_as_measured_and_never_falls() -> None:
    # The study's: 0.75 px without blur, and by 9 px of it 1.36 of the two axes together.
    sigma = blurred_sigma_px(0.75, np.array([0.0, 9.0]))
    assert sigma[0] == 0.75 and sigma[1] == pytest.approx(1.36, abs=0.1)
    each = blurred_sigma_px(np.array([1.0, 2.0, 3.0]), np.array([np.nan, 0.0, 5.0]))
    assert (each[:2] == [1.0, 2.0]).all() and each[2] > 3.0
    assert blurred_sigma_px(np.empty(0), np.empty(0)).shape == (0,)


def test_only_what_the_scene_cannot_explain_counts_as_blur() -> None:
    still = np.zeros(3)
    assert (blurred_sigma_px(1.0, still, 0.8) == 1.0).all()
    soft, softer = blurred_sigma_px(1.0, still, 0.6), blurred_sigma_px(1.0, still, 0.4)
    assert (soft > 1.0).all() and (softer > soft).all()
    # Blur that was expected is not counted again.
    expected = np.full(3, 40.0)
    assert (blurred_sigma_px(1.0, expected, 0.6) == blurred_sigma_px(1.0, expected)).all()
    assert np.isfinite(blurred_sigma_px(1.0, still, 0.0)).all()
    assert (blurred_sigma_px(1.0, still, np.nan) == 1.0).all()
    assert (blurred_sigma_px(1.0, expected, 0.1, BlurSettings(sigma_per_px=0.0)) == 1.0).all()
