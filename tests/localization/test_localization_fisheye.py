"""A room seen by a fisheye of 150°: tracked and found, its rim weighted as its pixels tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import apart, unit

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import Camera
from ground_station.localization.attempt import Conditions
from ground_station.localization.estimate import State
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.localizer import Localizer
from ground_station.localization.matching import Matcher, describe
from ground_station.localization.settings import TrackingSettings, load_preset
from ground_station.localization.tracking import Keyframe, track

FISHEYE = Camera(
    fx_px=244.4, fy_px=245.1, cx_px=317.2, cy_px=241.9,
    model="fisheye", k1=-0.021, k2=0.0043, k3=-0.0012, k4=0.0002,
)  # fmt: skip


class Wide:
    """The conftest's room and what a fisheye sees of it, also of the rim that is not used."""

    def __init__(self, room, noise_px: float = 0.5) -> None:
        self.map = replace(room.map, info=replace(room.map.info, camera=FISHEYE))
        self.room, self.noise_px = room, noise_px

    def seen(self, wTc: np.ndarray) -> np.ndarray:
        """Pixels (M, 2) of all landmarks, NaN where they are not in the picture."""
        lm = self.map.landmarks
        pixels = FISHEYE.project(poses.transform(poses.inverse(wTc), lm.position_m))
        with np.errstate(invalid="ignore"):
            pixels[~((pixels >= 0) & (pixels <= [639, 479])).all(axis=1)] = np.nan
        return pixels

    def features(self, wTc: np.ndarray, most: int = 600, outliers: float = 0.2) -> Features:
        """Some of them with noise; a share of the features belongs to nothing."""
        rng, pixels = self.room.rng, self.seen(wTc)
        index = rng.permutation(np.flatnonzero(np.isfinite(pixels[:, 0])))[:most]
        pixels = pixels[index] + rng.normal(0, self.noise_px, (len(index), 2))
        rows = unit(self.map.landmarks.descriptor[index] + rng.normal(0, 0.03, (len(index), 64)))
        wrong = rng.random(len(index)) < outliers
        pixels[wrong] = rng.uniform(0, [639, 479], (int(wrong.sum()), 2))
        ones = np.ones(len(index), np.float32)
        return Features(pixels.astype(np.float32), ones, rows)


@pytest.fixture
def wide(room) -> Wide:
    return Wide(room)


def test_a_flight_is_tracked_from_a_rough_first_pose(wide, room, extractor):
    localizer = Localizer(wide.map, FISHEYE, extractor, load_preset("default"))
    times, path = room.path(30)
    guess = path[0] @ poses.exp([0.01, -0.01, 0.0, 0.03, 0.0, 0.02])
    localizer.set_initial_pose(guess, int(times[0]))
    off = []
    for time_ns, wTc in zip(times.tolist(), path, strict=True):
        features = wide.features(wTc)
        assert not FISHEYE.uses(features.keypoints_px).all()
        estimate = localizer.process_features(time_ns, features)
        assert estimate.state is State.TRACKING, estimate.reason
        assert FISHEYE.uses(estimate.observations.pixel_px).all()
        # In the picture's pixels, wherever in it: 0.5 px of noise, landmarks free within theirs.
        inlier = estimate.observations.inlier
        assert np.median(estimate.observations.residual_px[inlier]) < 1.5
        off.append(apart(estimate.wTc, wTc))
    assert (np.max(off, axis=0) < [0.03, np.radians(0.5)]).all()


def test_a_frame_is_found_anywhere_in_the_map(wide, room, extractor):
    localizer = Localizer(wide.map, FISHEYE, extractor, load_preset("default"))
    times, path = room.path(1)
    estimate = localizer.process_features(int(times[0]), wide.features(path[0]))
    assert estimate.localized, estimate.reason
    assert apart(estimate.wTc, path[0])[0] < 0.03


def test_the_noise_of_a_observation_grows_to_the_rim_as_its_pixels_do(wide, room):
    matcher = Matcher(wide.map, FISHEYE, load_preset("default"))
    _, path = room.path(1)
    pixels = wide.seen(path[0])
    landmark = np.flatnonzero(np.isfinite(pixels[:, 0]))
    landmark = landmark[FISHEYE.uses(pixels[landmark])]
    expected = Kinematics(0, path[0], np.zeros(6), np.eye(12))
    pixels = pixels[landmark]
    observations = matcher.observations(pixels, landmark, 0.5, expected, Conditions())
    steps = np.random.default_rng(2).normal(0, 0.01, (200, len(pixels), 2))
    kept = FISHEYE.uses(pixels + 0.1) & FISHEYE.uses(pixels - 0.1)
    moved = [FISHEYE.undistort_to_pinhole(p)[kept] for p in pixels + steps]
    scatter = np.sqrt(np.square(np.array(moved) - observations.pinhole_px[kept]).mean(axis=(0, 2)))
    assert observations.sigma_px.max() > 3.5 * observations.sigma_px.min()
    np.testing.assert_allclose(observations.sigma_px[kept] / 0.5, scatter / 0.01, rtol=0.25)


def test_features_beyond_what_is_used_and_points_followed_there_are_dropped(wide, room):
    _, path = room.path(1)
    features = wide.features(path[0])
    seen = describe(features, FISHEYE, Conditions())
    assert len(seen) == FISHEYE.uses(features.keypoints_px).sum() < len(features)
    assert np.isfinite(seen.pinhole_px).all()
    image = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    pixels = np.array([[320, 240], [150, 240], [10, 240]], np.float32)
    points = poses.transform(path[0], 3 * FISHEYE.rays(pixels))
    keyframe = Keyframe(0, image, path[0], pixels, np.arange(3), points, np.ones(3))
    found = track(keyframe, image, path[0], FISHEYE, TrackingSettings())
    assert found.point.tolist() == [0, 1] and found.sought == 2
