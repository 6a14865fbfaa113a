"""Keyframes, searches and what is published: what a wrong pose must not pass."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from synthetic import CAMERA, FakeExtractor, apart, preset_with, unit

from ground_station.experiments.disturbances.scale import Scale
from ground_station.geometry import poses
from ground_station.localization.acquisition import Acquirer
from ground_station.localization.attempt import Conditions, Stopwatch
from ground_station.localization.estimate import Counts, no_observations
from ground_station.localization.estimator import make_estimator
from ground_station.localization.following import Followed, Since, better, catch_up
from ground_station.localization.judge import covariance_in_map, covariance_in_world, crowded
from ground_station.localization.kinematics import no_solution
from ground_station.localization.localizer import Localizer
from ground_station.localization.matching import Matcher, describe
from ground_station.localization.relocalization import Relocalization
from ground_station.localization.settings import CovarianceSettings, for_live, load_preset
from ground_station.localization.tracking import Keyframe
from ground_station.map.uncertainty import Accuracy

HERE = np.array([0.02, -0.01, 0.03, 0.02, 0.01, -0.02])
SETTINGS = load_preset("default")


@pytest.fixture
def acquirer(room, extractor):
    matcher = Matcher(room.map, room.camera, SETTINGS)
    return Acquirer(room.map, matcher, extractor, SETTINGS)


def seen_from(room, wTc):
    return describe(room.features(wTc), room.camera, Conditions())


def estimator_at(room, wTc, sigma=None):
    estimator = make_estimator(room.camera, SETTINGS)
    estimator.restart(0, wTc, None if sigma is None else np.eye(6) * sigma**2)
    return estimator


def find(acquirer, seen, estimator=None):
    """A frame near what an estimator predicts, or anywhere."""

    def make():
        return make_estimator(acquirer.matcher.camera, SETTINGS)

    expected = [] if estimator is None else [estimator.predict(0)]
    return acquirer.find(seen, 0, expected, estimator or make(), make, Stopwatch())


def test_live_nothing_is_waited_for_and_nothing_else_changes():
    assert SETTINGS.tracking.features_lag_s > 0
    assert for_live(SETTINGS) == preset_with(tracking={"features_lag_s": 0.0})


def test_a_right_pose_explains_more_than_chance_and_wrong_ones_do_not(room, acquirer):
    _, path = room.path(120)
    least = SETTINGS.tracking.min_significance
    for k in (0, 60, 119):
        seen = seen_from(room, path[k])
        assert acquirer.matcher.support(seen, path[k]).significance > 2 * least
        for other in ((k + 50) % 120, (k + 70) % 120):
            assert acquirer.matcher.support(seen, path[other]).significance < 0.7 * least
        aside = path[k] @ poses.exp([0.1, -0.1, 0.1, 0.3, 0.1, 0.0])
        assert acquirer.matcher.support(seen, aside).significance < 0.7 * least


def test_a_search_near_a_wrong_and_certain_prediction_finds_nothing(room, acquirer):
    """Within a small radius chance matches agree with any pose: that is no find."""
    _, path = room.path(120)
    for k in range(0, 60, 6):
        seen = seen_from(room, path[k])
        estimator = estimator_at(room, path[k + 60], sigma=3e-3)
        found = acquirer.locate(seen, estimator.predict(0), estimator, Stopwatch())
        verified = acquirer._verified(seen, found, Stopwatch())
        assert verified.solution.state is None and not len(verified.matches)
        right = estimator_at(room, path[k] @ poses.exp(HERE))
        found = acquirer.locate(seen, right.predict(0), right, Stopwatch())
        sure = acquirer._verified(seen, found, Stopwatch())
        assert sure.solution is found.solution and sure.significance > 20
        metres, radians = apart(found.solution.state.wTc, path[k])
        assert metres < 0.02 and radians < 0.005


def test_a_frame_is_matched_around_until_its_pose_stays(room, acquirer, monkeypatch):
    """What matches around a pose that is far off draws it nearer by a few pixels a time."""
    _, path = room.path(120)
    seen, turned = seen_from(room, path[0]), path[0] @ poses.exp([0, 0.08, 0, 0, 0, 0])
    estimator = estimator_at(room, turned)
    expected = estimator.predict(0)
    right = acquirer.locate(seen, estimator_at(room, path[0]).predict(0), estimator, Stopwatch())
    a_pixel = acquirer.matcher.reach_px(np.array([0, 1.0, 0, 0, 0, 0])) ** -1
    rounds = []

    def nearer(seen, around, *_):
        left = poses.log(poses.inverse(around.wTc) @ path[0])
        step = left * min(1.0, 6 * a_pixel / np.linalg.norm(left[:3]))
        rounds.append(np.linalg.norm(left[:3]) / a_pixel)
        state = dataclasses.replace(around, wTc=around.wTc @ poses.exp(step))
        return dataclasses.replace(right, solution=dataclasses.replace(right.solution, state=state))

    monkeypatch.setattr(acquirer, "_locate_once", nearer)
    monkeypatch.setattr(acquirer, "_held_by_near", lambda seen, found, *_: found)
    found = acquirer.locate(seen, expected, estimator, Stopwatch())
    assert rounds[0] > 38 and np.hypot(*apart(found.solution.state.wTc, path[0])) < 1e-6
    assert 7 <= len(rounds) <= 9  # 6 px each, and one that moves nothing


def test_what_few_landmarks_speak_for_is_held_against_what_is_found_anywhere(
    room, acquirer, monkeypatch
):
    _, path = room.path(120)
    seen, estimator = seen_from(room, path[0]), estimator_at(room, path[0], sigma=3e-3)
    right = acquirer.locate(seen, estimator.predict(0), estimator, Stopwatch())
    near = dataclasses.replace(right, significance=9.0)
    rows = right.observations.inlier.nonzero()[0][:40]
    feature, landmark = right.matches.feature[rows], right.matches.landmark[rows]
    asked = []

    def found(excess, significance, at=path[0], near=near):
        candidate = Relocalization(at, feature, landmark, significance, 0.001, "")
        acquirer._relocalizer = SimpleNamespace(
            candidates=lambda *_: asked.append(1) or [candidate], alone=lambda all_: all_[0]
        )
        monkeypatch.setattr(
            acquirer, "_verified", lambda *_: dataclasses.replace(near, excess=excess)
        )
        return find(acquirer, seen, estimator)

    assert found(excess=0.3, significance=90).significance == 9 and not asked
    assert found(excess=0.01, significance=90).significance == 90 and asked
    assert found(excess=0.01, significance=5).significance == 9
    # A find that cannot be solved is none, however much spoke for it.
    monkeypatch.setattr(acquirer, "_agreed", lambda *_: None)
    away = path[0] @ poses.exp([0, 2.0, 0, 0, 0, 0])
    kept = found(excess=0.01, significance=90, at=away)
    assert kept.significance == 9 and kept.solution.state is not None


def test_a_pose_is_checked_up_to_the_models_own_distance(room, extractor):
    """Descriptors of one point that lie farther apart than RootSIFT's speak for it as well."""
    _, path = room.path(120)
    plain = room.features(path[0])
    noise = np.random.default_rng(1).normal(size=plain.descriptors.shape)
    far = unit(plain.descriptors + 1.3 * unit(noise))
    off = np.linalg.norm(far - plain.descriptors, axis=1)
    assert np.quantile(off, 0.05) > 0.75 and np.quantile(off, 0.95) < 1.1
    seen = describe(dataclasses.replace(plain, descriptors=far), room.camera, Conditions())
    near, wide = (
        Acquirer(room.map, Matcher(room.map, room.camera, SETTINGS, scale), extractor, SETTINGS)
        for scale in (1.0, 1.6)
    )
    assert near.matcher.support(seen, path[0]).share < 0.05
    assert wide.matcher.support(seen, path[0]).significance > 10
    assert find(near, seen).solution.state is None
    assert apart(find(wide, seen).solution.state.wTc, path[0])[0] < 0.03


def test_a_doubtful_find_counts_only_beside_a_prediction_that_says_where(room, acquirer):
    _, path = room.path(120)
    seen = seen_from(room, path[0])
    right = acquirer.locate(
        seen, estimator_at(room, path[0]).predict(0), estimator_at(room, path[0]), Stopwatch()
    )

    def found(at, sigma, doubt="18 of 60 landmarks where they should be"):
        rows = right.observations.inlier.nonzero()[0][:40]
        candidate = Relocalization(
            at, right.matches.feature[rows], right.matches.landmark[rows], 8.0, 0.001, doubt
        )
        acquirer._relocalizer = SimpleNamespace(
            candidates=lambda *_: [candidate],
            alone=lambda found: found[0].doubt or found[0],
        )
        estimator = estimator_at(room, path[0] @ poses.exp(HERE), sigma)
        assert not acquirer.matcher.within_reach(estimator.predict(0))
        return find(acquirer, seen, estimator)

    near = found(path[0], sigma=0.06).solution.state
    assert near is not None
    assert np.linalg.norm((poses.inverse(path[0]) @ near.wTc)[:3, 3]) < 0.02
    anywhere = found(path[0], sigma=0.8)
    assert anywhere.solution.state is None and "18 of 60" in anywhere.solution.reason
    assert found(path[0], sigma=0.8, doubt="").solution.state is not None


def test_what_is_far_from_its_prediction_is_found_within_the_predictions_doubt(room, acquirer):
    """The search radius follows the covariance: a sure prediction looks near, an unsure one far."""
    _, path = room.path(1)
    seen = seen_from(room, path[0])
    aside = path[0] @ poses.exp([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])  # some 25 px
    matches = {}
    for sigma in (1e-4, 0.05):
        expected = estimator_at(room, aside, sigma).predict(0)
        matches[sigma] = acquirer.matcher.match(seen, expected, None, Stopwatch())
    assert len(matches[1e-4]) < 0.3 * len(matches[0.05])


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_a_smaller_picture_is_searched_at_the_same_angle(room, preset):
    """Turned by 60 px of 640, or 30 px of 320, no landmark is found that is not one by chance."""
    _, path = room.path(1)
    coarse = Scale(0.5).camera(room.camera)
    features = room.features(path[0])
    half = dataclasses.replace(features, keypoints_px=(features.keypoints_px + 0.5) / 2 - 0.5)
    turned = path[0] @ poses.exp([0.0, 60 / room.camera.fx_px, 0.0, 0.0, 0.0, 0.0])
    for seen, camera in ((features, room.camera), (half, coarse)):
        matcher = Matcher(room.map, camera, load_preset(preset))
        described = describe(seen, camera, Conditions())
        for wTc, share in ((path[0], (0.7, 1.0)), (turned, (0.0, 0.1))):
            matches = matcher.match(
                described, estimator_at(room, wTc, 0.1).predict(0), None, Stopwatch()
            )
            assert share[0] <= len(matches) / matches.projected <= share[1]


def test_a_model_of_larger_distances_has_larger_limits_and_no_others_change(room):
    """Features some 0.8 from their landmarks: beyond RootSIFT's 0.7, within a model's of 1.5."""
    _, path = room.path(1)
    features = room.features(path[0], outliers=0.0)
    noise = np.random.default_rng(3).normal(0, 0.13, features.descriptors.shape)
    moved = unit(features.descriptors + noise)
    features = dataclasses.replace(features, descriptors=moved)
    expected = estimator_at(room, path[0]).predict(0)

    def matches(preset, scale):
        matcher = Matcher(room.map, room.camera, load_preset(preset), scale)
        described = describe(features, room.camera, Conditions())
        return matcher.match(described, expected, None, Stopwatch())

    near, far = matches("default", 1.0), matches("default", 1.5)
    assert len(near) < 0.2 * len(far) and len(far) > 0.6 * len(features)
    own = np.linalg.norm(
        moved[far.feature] - room.map.landmarks.descriptor[far.landmark].astype(np.float32), axis=1
    )
    assert far.distance == pytest.approx(own / 1.5, abs=1e-3)
    thesis, again = matches("thesis", 1.0), matches("thesis", 1.5)
    assert np.array_equal(thesis.feature, again.feature)
    assert np.array_equal(thesis.distance, again.distance)


def test_landmarks_are_expected_where_their_row_will_see_them(room, extractor):
    camera = dataclasses.replace(room.camera, readout_s=0.02)
    matcher = Matcher(room.map, camera, SETTINGS)
    _, path = room.path(1)
    observations = matcher.observations(
        [[320.0, 0.0], [320.0, 239.5], [320.0, 479.0]], np.arange(3), 2.0,
        estimator_at(room, path[0]).predict(0), Conditions(),
    )  # fmt: skip
    assert np.allclose(observations.row_s, [-0.01, 0.0, 0.01])
    still = Matcher(room.map, camera, preset_with(pose={"rolling_shutter": False}))
    assert not still.row_s(np.array([[0.0, 0.0], [0.0, 479.0]])).any()


def test_a_keyframe_with_far_fewer_points_does_not_replace_one_that_still_gives_many():
    def keyframe(count):
        return Keyframe(
            0, np.zeros((4, 4), np.uint8), np.eye(4), np.zeros((count, 2), np.float32),
            np.arange(count), np.zeros((count, 3)), np.ones(count),
        )  # fmt: skip

    new, old = keyframe(30), keyframe(200)
    still = Followed(no_solution(0, ""), Counts(inliers=150), no_observations(), 0.0, 0)
    assert better(new, old, still) is old
    assert better(new, None, still) is new and better(new, old, None) is new
    poor = dataclasses.replace(still, counts=Counts(inliers=40))
    assert better(new, old, poor) is new


def test_catching_up_gives_up_where_the_points_are_not(room, acquirer):
    _, path = room.path(1)
    seen = seen_from(room, path[0])
    estimator = estimator_at(room, path[0])
    found = acquirer.locate(seen, estimator.predict(0), estimator, Stopwatch())
    rng = np.random.default_rng(1)
    noise = [rng.integers(0, 255, (480, 640)).astype(np.uint8) for _ in range(2)]
    landed = SimpleNamespace(
        time_ns=0,
        state=found.solution.state,
        keyframe=acquirer.keyframe(0, noise[0], path[0], found),
    )
    fresh = make_estimator(room.camera, SETTINGS)
    assert catch_up(landed, [(0, noise[0])], acquirer.matcher, fresh)
    assert fresh.predict(0) is not None
    fresh = make_estimator(room.camera, SETTINGS)
    recent = [(k * 33_000_000, noise[min(k, 1)]) for k in range(4)]
    assert not catch_up(landed, recent, acquirer.matcher, fresh)


def test_all_inliers_are_followed_and_those_of_far_descriptors_less_trusted(room, acquirer):
    _, path = room.path(1)
    estimator = estimator_at(room, path[0])
    found = acquirer.locate(seen_from(room, path[0]), estimator.predict(0), estimator, Stopwatch())
    inlier = found.solution.inlier
    distance = np.where(np.arange(len(inlier)) % 2, 0.2, 0.6).astype(np.float32)
    found = dataclasses.replace(
        found, matches=dataclasses.replace(found.matches, distance=distance)
    )
    keyframe = acquirer.keyframe(0, np.zeros((480, 640), np.uint8), path[0], found)
    assert len(keyframe) == min(int(inlier.sum()), SETTINGS.tracking.max_points)
    far = set(found.matches.landmark[inlier & (distance > 0.5)].tolist())
    sigma_px = {True: 4 * SETTINGS.tracking.sigma_px, False: SETTINGS.tracking.sigma_px}
    expected = [sigma_px[landmark in far] for landmark in keyframe.landmark.tolist()]
    np.testing.assert_allclose(keyframe.sigma_px, expected, rtol=1e-6)


class Turning(FakeExtractor):
    """A camera that turns on the spot; only its first view is ever described, and not at once."""

    def __init__(self, room, wTc):
        self.seen, self.asked = room.features(wTc, noise_px=0.0, outliers=0.0), 0
        self.camera = camera = room.camera
        self.first = np.zeros((480, 640))
        for side in (4, 16, 32):  # as walls have it: coarse and fine
            shades = room.rng.uniform(0, 80, (480 // side, 640 // side))
            self.first += np.kron(shades, np.ones((side, side)))
        columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
        self.rays = camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))

    def extract(self, image):
        self.asked += 1
        return self.seen if self.asked > 1 else self.seen.where(np.zeros(len(self.seen), bool))

    def turned(self, angle_rad):
        """The first view's picture after a turn to the right, and the turn (4, 4)."""
        turn = poses.exp(np.array([0, angle_rad, 0, 0, 0, 0]))
        place = self.camera.project(self.rays @ turn[:3, :3].T).astype(np.float32)
        maps = place.reshape(self.camera.height_px, self.camera.width_px, 2)
        picture = cv2.remap(self.first, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(np.rint(picture), np.uint8), turn


@pytest.mark.parametrize("lag_s", [0.3, 1.5])
def test_a_search_that_takes_long_is_caught_up_with_over_all_that_was_turned_since(room, lag_s):
    """As on a slow computer, or a busy one: it was lost for as long as the camera moved."""
    wTc = room.path(1)[1][0]
    camera = Turning(room, wTc)
    settings = preset_with(tracking={"features_lag_s": lag_s})
    localizer = Localizer(room.map, room.camera, camera, settings)
    for k in range(round(30 * lag_s) + 5):
        picture, turn = camera.turned(0.2 * max(k - 1, 0) / 30)
        found = localizer.process(k * 33_333_333, picture, k)
        if found.wTc is not None:
            break
    assert found.wTc is not None and k >= 30 * lag_s
    metres, radians = apart(found.wTc, wTc @ turn)
    assert np.rad2deg(radians) < 0.2 and metres < 0.02


def test_frames_since_a_search_are_few_and_evenly_apart_and_end_with_the_last():
    since = Since()
    frames = [(10 * k, np.full((2, 2), k % 250, np.uint8)) for k in range(301)]
    for count, frame in enumerate(frames, 1):
        since.add(*frame)
        kept = [time_ns for time_ns, _ in since.after(-1)]
        assert kept[0] == 0 and kept[-1] == frame[0] and len(kept) <= 33
        assert len(kept) == count or len(kept) >= 16
        assert len(set(np.diff(kept[:-1]))) <= 1
    assert [time_ns for time_ns, _ in since.after(2900)] == kept[kept.index(2880) + 1 :]
    since.begin()
    assert since.after(-1) == []


def test_what_frames_have_in_common_is_no_less_for_many_than_for_one():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(12, 12))
    covariance, moves, none = A @ A.T, rng.normal(size=(6, 2)), np.zeros((2, 2))
    told = dataclasses.replace(
        no_solution(0, ""),
        information=np.diag(np.arange(1.0, 13.0)),
        pose_by_focal=moves,
        noise=3.0,
    )
    plain = covariance_in_map(covariance, told, CovarianceSettings(), none)
    assert np.array_equal(plain, covariance[:6, :6])
    more = covariance_in_map(covariance, told, CovarianceSettings(scale=2.0, shared=0.25), none)
    assert np.allclose(more, 3 * plain + 0.75 * np.diag(1 / np.arange(1.0, 7.0)))
    lenses = np.array([[0.01, 0.002], [0.002, 0.03]])
    more = covariance_in_map(covariance, told, CovarianceSettings(), lenses)
    assert np.allclose(more, plain + moves @ lenses @ moves.T)
    nothing = no_solution(0, "")
    shared = covariance_in_map(covariance, nothing, CovarianceSettings(shared=0.5), none)
    assert np.isinf(shared).all()
    same = covariance_in_map(covariance, nothing, CovarianceSettings(), lenses)
    assert np.array_equal(same, plain)
    thrice = covariance_in_map(covariance, told, CovarianceSettings(shared=0.25), none, 3.0)
    assert np.allclose(thrice, 0.75 * plain + 0.25 * 3 * 3 * np.diag(1 / np.arange(1.0, 7.0)))


def test_landmarks_that_lie_together_count_for_one_part_of_the_picture():
    one = np.stack(np.meshgrid(np.arange(5.0, 640, 40), np.arange(5.0, 480, 40)), axis=2)
    one = one.reshape(-1, 2).astype(np.float32)
    assert crowded(one, CAMERA) == 1.0
    assert crowded(np.repeat(one, 4, axis=0) + np.float32(9), CAMERA) == 4.0
    assert crowded(2 * one, dataclasses.replace(CAMERA, width_px=2 * CAMERA.width_px)) == 1.0


def test_the_maps_own_errors_are_added_by_their_share():
    covariance, wTc = np.diag(np.arange(1.0, 7.0)), np.eye(4)
    of_map = Accuracy(sigma_rad=0.1, sigma_m=2.0)
    assert np.array_equal(covariance_in_world(covariance, of_map, wTc, 0.0), covariance)
    more = covariance_in_world(covariance, of_map, wTc, 0.5)
    assert np.allclose(more - covariance, np.diag([0.0025] * 3 + [1.0] * 3))


@pytest.mark.parametrize("strip_px", [640, 60])
def test_pairs_that_chance_makes_are_left_out_and_right_ones_are_not(room, strip_px):
    """Limits so wide that strangers pair, in a whole picture and where all is in a strip of it."""
    _, path = room.path(1)
    whole = room.features(path[0], outliers=0.0, most=180)
    middle = abs(whole.keypoints_px[:, 0] - np.median(whole.keypoints_px[:, 0])) < strip_px / 2
    whole = whole.where(middle)
    rng = np.random.default_rng(4)
    strange = unit(rng.normal(0, 1, whole.descriptors.shape))
    order = rng.permutation(len(whole))
    features = dataclasses.replace(
        whole,
        keypoints_px=np.concatenate([whole.keypoints_px, whole.keypoints_px[order] + 3]),
        scores=np.concatenate([whole.scores, whole.scores]),
        descriptors=np.concatenate([whole.descriptors, strange]),
    )
    described = describe(features, room.camera, Conditions())
    expected = estimator_at(room, path[0]).predict(0)

    def right_and_wrong(share):
        wide = {"max_descriptor_distance": 1.6, "max_ratio": 1.0, "max_chance_share": share}
        matcher = Matcher(room.map, room.camera, preset_with(association=wide), 1.0)
        feature = matcher.match(described, expected, None, Stopwatch()).feature
        return (feature < len(whole)).sum(), (feature >= len(whole)).sum()

    every, cut = right_and_wrong(1.0), right_and_wrong(0.05)
    assert every[1] > 0.1 * every[0]
    assert cut[1] <= 0.1 * cut[0] and cut[0] > 0.9 * every[0]


def test_a_find_is_as_open_as_its_landmarks_are_far(acquirer, room):
    _, path = room.path(1)
    depth_m = poses.transform(poses.inverse(path[0]), room.map.landmarks.position_m)[:, 2]
    ahead = np.flatnonzero(depth_m > 0.5)
    ahead = ahead[np.argsort(depth_m[ahead])]
    near, far = ahead[:21], ahead[-21:]
    assert depth_m[far[10]] > 1.5 * depth_m[near[10]]
    for seen in (near, far):
        sigma = np.sqrt(np.diag(acquirer._open(Relocalization(path[0], seen, seen))))
        assert sigma[:3] == pytest.approx(np.deg2rad(5.0))
        assert sigma[3:] == pytest.approx(np.deg2rad(5.0) * depth_m[seen[10]])
