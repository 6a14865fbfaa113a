"""A compressed map's tables give the numbers back as well as they are known."""

from __future__ import annotations

import numpy as np
import pytest

from ground_station.map import compact


def landmarks(count=500, seed=2, extent_m=40.0):
    rng = np.random.default_rng(seed)
    sigma = 10 ** rng.uniform(-3, -1, (count, 3))  # long along the line of sight, as they are
    turn, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    covariance = turn @ (sigma[:, :, None] ** 2 * np.swapaxes(turn, 1, 2))
    ray = rng.normal(size=(count, 3))
    return {
        "id": rng.permutation(10 * count)[:count].astype(np.int64),
        "position_m": rng.uniform(-1, 1, (count, 3)) * extent_m + [1000.0, -500.0, 3.0],
        "covariance_m2": covariance.astype(np.float32),
        "spread": rng.uniform(0, 0.7, count).astype(np.float32),
        "view_direction": (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32),
        "view_cos": rng.uniform(-1, 1, count).astype(np.float32),
        "distance_m": rng.uniform(0.3, 30, (count, 2)).astype(np.float32),
        "observations": rng.integers(2, 90_000, count).astype(np.int32),
    }


def keyframes(count=40, sights=2000, landmarks=500, width_px=640, seed=3):
    rng = np.random.default_rng(seed)
    return {
        "time_ns": np.arange(count, dtype=np.int64),
        "wTc": np.tile(np.eye(4), (count, 1, 1)),
        "offset": np.linspace(0, sights, count + 1).astype(np.int64),
        "landmark": rng.integers(0, landmarks, sights).astype(np.int32),
        "pixel_px": rng.uniform(-0.5, width_px - 0.5, (sights, 2)).astype(np.float32),
    }


def test_landmarks_come_back_far_better_than_they_are_known():
    plain = landmarks()
    again = compact.unpack_landmarks(compact.pack_landmarks(plain))
    assert {name: value.dtype for name, value in again.items()} == {
        name: value.dtype for name, value in plain.items()
    }
    assert np.array_equal(again["id"], plain["id"])
    assert np.abs(again["position_m"] - plain["position_m"]).max() < 5e-6
    for name in ("spread", "view_direction", "view_cos", "distance_m"):
        assert np.allclose(again[name], plain[name], rtol=1e-3, atol=1e-3)
    assert np.array_equal(again["observations"], np.minimum(plain["observations"], 65535))


def test_covariances_stay_covariances_and_lose_no_tenth_in_any_direction():
    plain = landmarks()["covariance_m2"]
    packed = compact.pack_landmarks(landmarks())
    again = compact.unpack_landmarks(packed)["covariance_m2"].astype(float)
    values = np.linalg.eigvalsh(again)
    assert (values > 0).all()
    # In the coordinates in which the old one is 1 in every direction.
    root = np.linalg.inv(np.linalg.cholesky(plain.astype(float)))
    ratio = np.linalg.eigvalsh(root @ again @ np.swapaxes(root, 1, 2))
    assert ratio.min() > 0.9 and ratio.max() < 1.1
    assert np.median(np.abs(ratio - 1)) < 0.005


def test_a_covariance_that_is_flat_or_nothing_is_borne():
    plain = landmarks(3)
    plain["covariance_m2"][0] = 0
    plain["covariance_m2"][1] = np.diag(np.float32([1e-4, 0, 0]))
    plain["covariance_m2"][2] = np.diag(np.float32([1e-4, 1e-4, -1e-9]))  # rounded below nothing
    again = compact.unpack_landmarks(compact.pack_landmarks(plain))["covariance_m2"]
    assert np.allclose(again[0], 0)
    assert np.allclose(again[1:], plain["covariance_m2"][1:], atol=2e-7)
    assert (np.linalg.eigvalsh(again.astype(float)) >= 0).all()


def test_a_landmark_is_less_than_half_and_a_sight_is_half():
    plain, packed = landmarks(), compact.pack_landmarks(landmarks())
    size = sum(packed[name].nbytes for name in compact.LANDMARKS)
    assert size / sum(array.nbytes for array in plain.values()) < 0.5
    plain, packed = keyframes(), compact.pack_keyframes(keyframes())
    for name, share in (("landmark", 2), ("pixel_steps", 2)):
        whole = plain["pixel_px" if name == "pixel_steps" else name]
        assert packed[name].nbytes * share == whole.nbytes


@pytest.mark.parametrize(("width_px", "most_px"), [(640, 0.008), (4056, 0.04)])
def test_pixels_come_back_within_half_a_step(width_px, most_px):
    plain = keyframes(width_px=width_px)
    again = compact.unpack_keyframes(compact.pack_keyframes(plain))
    assert np.abs(again["pixel_px"] - plain["pixel_px"]).max() < most_px
    for name in ("time_ns", "wTc", "offset", "landmark"):
        assert np.array_equal(again[name], plain[name]) and again[name].dtype == plain[name].dtype


def test_large_numbers_get_the_wide_types():
    plain = landmarks(4)
    assert compact.pack_landmarks(plain)["id"].dtype == np.uint32
    for far in (2**40, -1):
        plain["id"][1] = far
        packed = compact.pack_landmarks(plain)
        assert packed["id"].dtype == np.int64
        assert compact.unpack_landmarks(packed)["id"][1] == far
    packed = compact.pack_keyframes(keyframes(landmarks=70_000, sights=9000))
    assert packed["landmark"].dtype == np.uint32


def test_tables_without_a_row_come_back():
    none = {name: array[:0] for name, array in landmarks(3).items()}
    assert all(len(v) == 0 for v in compact.unpack_landmarks(compact.pack_landmarks(none)).values())
    none = keyframes(count=2, sights=0)
    assert len(compact.unpack_keyframes(compact.pack_keyframes(none))["pixel_px"]) == 0


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("position_origin_m", np.zeros((2, 3)), "'position_origin_m' has 2 rows, not 1"),
        ("position_origin_m", np.zeros((0, 3)), "'position_origin_m' has 0 rows"),
        ("covariance_unit_m", np.array([1e300]), "not finite"),
    ],
)
def test_units_that_are_none_are_refused(name, value, words):
    packed = compact.pack_landmarks(landmarks(5)) | {name: value}
    with pytest.raises(ValueError, match=words):
        compact.unpack_landmarks(packed)


def test_steps_that_go_beyond_what_is_finite_are_refused():
    packed = compact.pack_keyframes(keyframes()) | {"pixel_step_px": np.array([1e300])}
    with pytest.raises(ValueError, match="not finite"):
        compact.unpack_keyframes(packed)
