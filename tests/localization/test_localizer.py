"""The localizer over sequences of a synthetic room: what it says, and when it says it is lost."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic import apart, preset_with, unit_rows

from ground_station.errors import InputError, MapError
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.localization.attempt import Conditions
from ground_station.localization.estimate import State
from ground_station.localization.localizer import LocalizationError, Localizer
from ground_station.localization.matching import describe
from ground_station.localization.settings import load_preset

NOTHING = Features(
    np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 64), np.float32)
)


class Flight:
    """A localizer in the room, and frames of one way round it."""

    def __init__(self, room, extractor, preset="default", **tables):
        self.localizer = Localizer(room.map, room.camera, extractor, preset_with(preset, **tables))
        self.features, (self.times, self.path) = room.features, room.path(300)

    def started(self):
        """The same, told where it begins."""
        self.localizer.set_initial_pose(self.path[0], int(self.times[0]))
        return self

    def frame(self, k, features=None):
        """What becomes of a frame that sees what it should, or these features."""
        if features is None:
            features = self.features(self.path[k])
        return self.localizer.process_features(int(self.times[k]), features)

    def off_m(self, estimate, k):
        return apart(estimate.wTc, self.path[k])[0]


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_a_sequence_is_tracked_within_centimetres(room, extractor, preset):
    flight = Flight(room, extractor, preset)
    guess = flight.path[0] @ poses.exp([0.01, -0.01, 0.0, 0.03, 0.0, 0.02])
    flight.localizer.set_initial_pose(guess, int(flight.times[0]))
    off = []
    for k in range(45):
        estimate = flight.frame(k)
        assert estimate.state is State.TRACKING, estimate.reason
        off.append(apart(estimate.wTc, flight.path[k]))
        assert estimate.counts.inliers == estimate.observations.inlier.sum()
        assert estimate.counts.projected >= len(estimate.observations)
        assert {"projection", "association", "pose", "total"} <= set(estimate.stage_ms)
        assert (np.linalg.eigvalsh(estimate.covariance) > 0).all()
    assert (np.max(off, axis=0) < [0.03, np.radians(0.5)]).all()
    assert (np.sqrt(np.square(off).mean(axis=0)) < [0.015, np.radians(0.2)]).all()


def test_what_a_map_is_off_is_in_the_covariance_and_degrades_nothing(room, extractor):
    seen = room.features(room.path(1)[1][0])

    def of(preset, **registration):
        room.map.info.registration = registration
        return Flight(room, extractor, preset).started().frame(0, seen)

    plain, bent = of("default"), of("default", sigma_m=0.5, sigma_deg=3.0)
    more = np.diag([np.radians(3.0) ** 2] * 3 + [0.25] * 3)
    assert np.allclose(bent.covariance, plain.covariance + more)
    assert bent.state is plain.state is State.TRACKING  # about a map nothing can be done in flight
    assert np.array_equal(of("thesis", sigma_m=0.5).covariance, of("thesis").covariance)
    with pytest.raises(MapError, match="registration: 'sigma_m'"):
        of("default", sigma_m=[1, 2])


def test_without_a_first_pose_it_finds_itself_and_is_sure(room, extractor):
    first = Flight(room, extractor).frame(0)
    assert first.relocalized and first.state is State.TRACKING


def test_a_weak_find_waits_for_confirmation(room, extractor):
    flight = Flight(room, extractor, state={"sure_significance": 1e9})
    first, second, third = (flight.frame(k) for k in range(3))
    assert first.localized and first.relocalized and first.state is State.DEGRADED
    assert "confirm" in first.reason
    assert second.state is State.DEGRADED and "1 of 2 frames agree" in second.reason
    assert third.state is State.TRACKING and not third.relocalized
    assert flight.off_m(third, 2) < 0.02


def test_the_thesis_preset_never_finds_itself(room, extractor):
    flight = Flight(room, extractor, "thesis")
    for k in range(2):
        estimate = flight.frame(k)
        assert not estimate.localized and estimate.state is State.INITIALIZING
        assert estimate.reason == "no first pose"


def test_a_blackout_ends_in_lost_and_the_default_comes_back_elsewhere(room, extractor):
    flight = Flight(room, extractor).started()
    for k in range(3):
        flight.frame(k)
    states = [flight.frame(k, NOTHING).state for k in range(3, 30)]
    assert states[0] is State.DEGRADED and states[-1] is State.LOST
    lost_from = states.index(State.LOST)
    assert all(state is State.LOST for state in states[lost_from:])
    assert (flight.times[3 + lost_from] - flight.times[2]) / 1e9 == pytest.approx(0.3, abs=0.05)
    back, _, after = (flight.frame(k) for k in (250, 251, 252))
    assert back.relocalized and back.state is State.TRACKING
    assert after.state is State.TRACKING and flight.off_m(after, 252) < 0.02


def test_the_thesis_preset_is_lost_at_the_first_failure_and_says_so(room, extractor):
    flight = Flight(room, extractor, "thesis").started()
    assert flight.frame(0).localized
    failed = flight.frame(1, NOTHING)
    assert failed.state is State.LOST and failed.wTc is None and failed.covariance is None
    assert failed.reason == "0 observations"
    elsewhere = flight.frame(199)
    assert elsewhere.state is State.LOST and not elsewhere.localized


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_frames_of_another_building_are_never_tracked(room, extractor, preset):
    flight, rng = Flight(room, extractor, preset).started(), np.random.default_rng(99)
    for k in range(20):
        pixels = rng.uniform(0, [640, 480], (500, 2)).astype(np.float32)
        other = Features(pixels, np.ones(500, np.float32), unit_rows(rng, 500))
        estimate = flight.frame(k, other)
        assert not estimate.localized and estimate.state is not State.TRACKING


def test_a_believed_pose_needs_most_of_its_own_observations(room, extractor):
    for share, believed in ((0.35, True), (0.9, False)):
        flight = Flight(room, extractor, "thesis", pose={"min_inlier_share": share}).started()
        features = room.features(flight.path[0], outliers=0.0)
        features.keypoints_px[::3] += [18.0, 18.0]
        estimate = flight.frame(0, features)
        assert estimate.localized == believed, estimate.reason
    assert "inliers of" in estimate.reason and estimate.state is State.INITIALIZING
    assert len(estimate.observations) == 0


def test_features_that_are_not_finite_are_left_out(room, extractor):
    flight = Flight(room, extractor).started()
    features = room.features(flight.path[0])
    features.keypoints_px[::5] = np.nan
    features.descriptors[1::5] = np.inf
    estimate = flight.frame(0, features)
    assert estimate.localized and flight.off_m(estimate, 0) < 0.02
    left = len(features) - len(features.keypoints_px[::5]) - len(features.descriptors[1::5])
    assert len(describe(features, room.camera, Conditions())) == left
    features.keypoints_px[:] = np.nan
    assert not flight.frame(1, features).localized


def test_a_time_that_jumps_back_is_refused_and_changes_nothing(room, extractor):
    flight = Flight(room, extractor).started()
    for k in range(3):
        flight.frame(k)
    for k in (1, 2):
        refused = flight.frame(k)
        assert refused.reason.startswith("refused") and refused.wTc is None
        assert refused.state is not State.TRACKING
    assert flight.frame(3).state is State.TRACKING
    flight.localizer.reset()
    assert flight.started().frame(0).localized


def test_a_dull_frame_is_gated_and_degrades_before_it_is_lost(room, extractor):
    flight = Flight(room, extractor, "thesis").started()
    flight.frame(0)
    grey = np.full((480, 640), 128, np.uint8)
    first, late = (flight.localizer.process(int(flight.times[k]), grey, k) for k in (1, 29))
    assert first.gated and first.wTc is None and first.state is State.DEGRADED
    assert first.reason == "entropy 0.00 below 7 bits"
    assert late.gated and late.state is State.LOST


def test_a_frame_of_another_size_is_refused_by_name(room, extractor):
    localizer = Flight(room, extractor).localizer
    with pytest.raises(InputError, match="frame 5 has 320x240 pixels, the camera 640x480"):
        localizer.process(0, np.zeros((240, 320), np.uint8), 5)


def test_a_map_of_other_features_is_refused_by_name(room, extractor):
    room.map.info.features_sha256 = "1" * 64
    with pytest.raises(MapError, match="built with 'synthetic'"):
        Flight(room, extractor)


def test_a_first_pose_that_is_no_rigid_motion_is_refused(room, extractor):
    localizer = Flight(room, extractor).localizer
    for bad in (np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1])):
        with pytest.raises(LocalizationError, match="initial pose"):
            localizer.set_initial_pose(bad, 0)


def test_an_empty_map_localizes_nothing(room, extractor):
    landmarks = room.map.landmarks
    for field in dataclasses.fields(landmarks):
        setattr(landmarks, field.name, getattr(landmarks, field.name)[:0])
    assert not Flight(room, extractor).started().frame(1, NOTHING).localized


def test_what_the_prediction_misses_is_found_in_the_same_frame(room, extractor):
    """At a few frames a second the direction changes between two of them."""
    flight = Flight(room, extractor)
    for n, k in enumerate([0, 20, 10, 60, 30, 90, 150]):
        found = flight.localizer.process_features(n * 500_000_000, room.features(flight.path[k]))
        assert found.localized and found.state is State.TRACKING
        assert flight.off_m(found, k) < 0.02


def test_a_turn_that_nothing_foretold_is_no_new_beginning(room, extractor):
    """A find that a wild camera may have reached keeps the motion known so far and adds to it."""
    localizer = Flight(room, extractor).localizer
    _, path = room.path(30, rate_hz=10.0)
    turned = poses.exp([0.0, np.deg2rad(6.0), 0.0, 0.0, 0.0, 0.0])
    for k in range(30):
        wTc = path[k] @ turned if k == 20 else path[k]
        found = localizer.process_features(k * 100_000_000, room.features(wTc))
        assert found.localized and apart(found.wTc, wTc)[0] < 0.02
        assert found.state is State.TRACKING and found.relocalized == (k == 0)


def test_what_is_looked_at_from_far_outside_of_its_cones_is_found_and_followed(room, extractor):
    landmarks = room.map.landmarks
    aside = poses.exp([0.0, 0.0, np.deg2rad(75.0), 0.0, 0.0, 0.0])[:3, :3]
    landmarks.view_direction[:] = landmarks.view_direction @ aside.T
    landmarks.view_cos[:] = np.cos(np.deg2rad(10.0))
    landmarks.distance_m[:] *= 3.5
    flight = Flight(room, extractor)
    found = [flight.frame(k) for k in range(40)]
    assert found[0].relocalized and not any(each.relocalized for each in found[1:])
    assert all(each.state is State.TRACKING for each in found)
    assert max(flight.off_m(each, k) for k, each in enumerate(found)) < 0.03


def test_a_first_pose_from_elsewhere_forgets_what_was_seen(room, extractor, monkeypatch):
    flight, recent = Flight(room, extractor).started(), []
    find = flight.localizer._acquirer.find

    def asked(seen, *others):
        recent.append(seen.taken.recent)
        return find(seen, *others)

    monkeypatch.setattr(flight.localizer._acquirer, "find", asked)
    flight.frame(0)
    flight.frame(1)
    flight.localizer.set_initial_pose(flight.path[150], int(flight.times[150]))
    flight.frame(150)
    assert recent[0] is None and len(recent[1]) > 12 and recent[2] is None


def test_a_find_that_the_camera_cannot_have_reached_waits_for_confirmation(room, extractor):
    flight = Flight(room, extractor).started()
    for k in range(3):
        flight.frame(k)
    there = flight.frame(3, room.features(flight.path[250]))
    assert there.localized and there.relocalized and there.state is State.DEGRADED
    assert "to be confirmed" in there.reason


@pytest.mark.parametrize("units", [0.05, 0.5, 2.0, 30.0])
def test_a_map_without_units_localizes_as_one_in_metres(room, extractor, units):
    lm = room.map.landmarks
    scaled = dataclasses.replace(
        room.map,
        info=dataclasses.replace(room.map.info, frame="map"),
        landmarks=dataclasses.replace(
            lm,
            position_m=lm.position_m * units,
            covariance_m2=lm.covariance_m2 * np.float32(units**2),
            distance_m=lm.distance_m * np.float32(units),
        ),
    )
    localizer = Localizer(scaled, room.camera, extractor, load_preset("default"))
    times, path = room.path(20, rate_hz=10.0)
    for time_ns, true in zip(times.tolist(), path, strict=True):
        found = localizer.process_features(time_ns, room.features(true))
        assert found.state is State.TRACKING
        found_m = found.wTc[:3, 3] / units
        assert np.linalg.norm(found_m - true[:3, 3]) < 0.02
