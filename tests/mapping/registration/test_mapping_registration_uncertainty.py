"""The printed uncertainty is the registration's: drawn often, it holds as often as it says."""

from __future__ import annotations

import numpy as np
import pytest
from known_places import HALL_M, hall, in_map, known, similarity
from scipy.spatial.transform import Rotation

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment, align
from ground_station.map.uncertainty import Uncertainty, describe, region
from ground_station.mapping.registration.adjustment import Upright, adjust
from ground_station.mapping.registration.registration import robust_similarity

NOISE_M = 0.05
DRAWS = 500
SIX = np.array(
    [[0, 0, 1], [24, 1, 4], [22, 16, 2], [1, 15, 5], [12, 0, 5], [11, 16, 0.5]], np.float64
)
TRUTH = similarity()
PLACES = np.vstack([HALL_M / 2, np.zeros(3), HALL_M, [0, HALL_M[1], 0]])


def off(fit: Alignment, places: np.ndarray) -> np.ndarray:
    """How far a registration puts places of the world from where they are."""
    return np.linalg.norm(fit.apply(in_map(TRUTH, places)) - places, axis=1)


@pytest.fixture(scope="module")
def six_points():
    """Errors and printed 90 % radii at places of the hall, and scales, of many draws."""
    rng = np.random.default_rng(4)
    errors, radii, sigmas, scales = [], [], [], []
    for _ in range(DRAWS):
        told = SIX + NOISE_M * rng.normal(size=SIX.shape)
        points = known(TRUTH, SIX, told)
        plain, used = robust_similarity(points.model, told, np.zeros(6), 0, "points")
        found = adjust(plain, points.of(used))
        errors.append(off(found.fit, PLACES))
        radii.append(found.uncertainty.radius_m(PLACES))
        sigmas.append(found.uncertainty.sigma_m(PLACES))
        scales.append(np.log(found.fit.scale / TRUTH.scale) / found.uncertainty.scale_sigma)
    return np.array(errors), np.array(radii), np.array(sigmas), np.array(scales)


def test_the_printed_radius_covers_nine_of_ten_draws(six_points):
    """Of 500 draws, 0.9 is met within three standard deviations: 0.86 to 0.94."""
    errors, radii, _, _ = six_points
    covered = (errors <= radii).mean(axis=0)
    assert (covered > 0.86).all() and (covered < 0.94).all(), covered


def test_the_expected_error_is_the_errors_root_mean_square(six_points):
    errors, _, sigmas, _ = six_points
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / np.sqrt(np.mean(sigmas**2, axis=0))
    assert (ratio > 0.9).all() and (ratio < 1.1).all(), ratio


def test_the_scales_deviation_is_students(six_points):
    """Eleven degrees of freedom: 90 % of |t| are below 1.796."""
    assert 0.85 < np.mean(np.abs(six_points[3]) < 1.796) < 0.95


def test_six_points_of_five_centimetres_are_enough_for_six(six_points):
    assert np.median(six_points[0][:, 0]) < 0.06


def test_fewer_points_are_less_certain_than_their_scatter_alone_says():
    known_well = Uncertainty(np.eye(7) * 1e-4, np.zeros(3), 1e6)
    known_badly = Uncertainty(np.eye(7) * 1e-4, np.zeros(3), 2)
    place = np.zeros((1, 3))
    # Three axes alike: chi-square with three degrees of freedom, 6.2514 at 90 %.
    assert known_well.radius_m(place)[0] == pytest.approx(0.01 * np.sqrt(6.2514), rel=1e-3)
    # Fisher's F with 3 and 2: 9.1618 at 90 %.
    assert known_badly.radius_m(place)[0] == pytest.approx(0.01 * np.sqrt(3 * 9.1618), rel=1e-3)


def test_near_and_far_points_weigh_by_both_noises():
    """Where places are known to 5 cm, the one that is seen best must not carry all."""
    rng = np.random.default_rng(5)
    sigma = np.array([0.0005, 0.01, 0.01, 0.01, 0.02, 0.02])
    covariance = np.eye(3) * (sigma**2)[:, None, None]
    by_observations, by_both, scatter = [], [], []
    for _ in range(60):
        told = SIX + NOISE_M * rng.normal(size=SIX.shape)
        points = known(TRUTH, SIX, told, covariance=covariance)
        points.model[:] += sigma[:, None] * rng.normal(size=SIX.shape)
        weights = 1 / covariance[:, 0, 0]
        pixels_only = align(points.model, told, True, weights)
        by_observations.append(off(pixels_only, PLACES)[0])
        found = adjust(pixels_only, points)
        by_both.append(off(found.fit, PLACES)[0])
        scatter.append(found.scatter_m)
    assert np.median(by_both) < 0.85 * np.median(by_observations)
    assert np.sqrt(np.mean(np.square(scatter))) == pytest.approx(NOISE_M, rel=0.15)


def test_places_without_noise_weigh_by_their_observations_alone():
    rng = np.random.default_rng(6)
    sigma = np.array([0.002, 0.002, 0.002, 0.3, 0.3, 0.3])
    covariance = np.eye(3) * (sigma**2)[:, None, None]
    points = known(TRUTH, SIX, SIX, covariance=covariance)
    points.model[:] += sigma[:, None] * rng.normal(size=(6, 3))
    found = adjust(TRUTH, points)
    assert found.scatter_m < 0.01
    assert off(found.fit, SIX[:3]).max() < 0.03


def test_corners_of_one_thing_do_not_count_as_many():
    """Four corners that are displaced together are one measurement."""
    rng = np.random.default_rng(7)
    corners = np.array([[0, -1, 1], [0, 1, 1], [0, 1, -1], [0, -1, -1]]) * 0.1
    covered = []
    for _ in range(120):
        shift = NOISE_M * rng.normal(size=(6, 1, 3))
        world = (SIX[:, None] + corners).reshape(-1, 3)
        told = (SIX[:, None] + corners + shift).reshape(-1, 3)
        points = known(TRUTH, world, told, group=np.repeat(np.arange(6), 4))
        found = adjust(align(points.model, told, True), points)
        covered.append(off(found.fit, PLACES) <= found.uncertainty.radius_m(PLACES))
    assert (np.mean(covered, axis=0) > 0.82).all() and np.mean(covered) < 0.97


def test_a_plans_points_with_the_vertical_are_as_certain_as_they_say():
    rng = np.random.default_rng(8)
    tilt_rad, level_m = np.radians(0.3), 0.03
    errors, radii = [], []
    for _ in range(120):
        told = SIX + NOISE_M * rng.normal(size=SIX.shape)
        told[:, 2] = 0
        up = Rotation.from_rotvec([*(tilt_rad * rng.normal(size=2)), 0]).apply([0, 0, 1])
        direction = up @ TRUTH.rotation
        level = float(in_map(TRUTH, np.array([[12.0, 8.0, level_m * rng.normal()]]))[0] @ direction)
        upright = Upright(direction, tilt_rad, level, level_m / TRUTH.scale)
        found = adjust(TRUTH, known(TRUTH, SIX, told, axes=2), upright)
        errors.append(off(found.fit, PLACES))
        radii.append(found.uncertainty.radius_m(PLACES))
    covered = (np.array(errors) <= np.array(radii)).mean(axis=0)
    assert (covered > 0.84).all() and (covered < 0.99).all(), covered


def test_a_report_has_the_middle_and_the_worst_corner():
    found = Uncertainty(
        np.diag([0, 0, 1e-3, 1e-2, 1e-2, 1e-2, 1e-3]) ** 2, np.array([1.0, 1, 1]), 9
    )
    positions = hall(Alignment(np.eye(3), np.zeros(3), 1.0)).landmarks.position_m
    report = describe(found, positions)
    middle, corners = region(positions)
    assert np.allclose(middle, HALL_M / 2, atol=0.3) and len(corners) == 8
    assert np.allclose(report["corner_m"], HALL_M, atol=0.1)  # farthest from where it is known best
    assert report["corner_90_percent_m"] > report["centre_90_percent_m"] > 0
    assert report["centre_90_percent_m"] > report["centre_sigma_m"]
    assert report["scale_sigma_percent"] == pytest.approx(0.1)
    assert np.shape(report["covariance"]) == (7, 7) and len(report["covariance_order"]) == 7


def test_places_that_leave_it_open_are_refused():
    line = np.outer(np.arange(4.0), [1.0, 0, 0])
    points = known(TRUTH, line, line)
    with pytest.raises(MapError, match="the 4 positions lie on one line"):
        robust_similarity(points.model, line, np.zeros(4), 0, "positions")
