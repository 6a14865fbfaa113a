"""Frames in between: points followed from a keyframe, and keyframes made beside the tracking."""

from __future__ import annotations

import dataclasses
import os
import threading
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
import pytest
from synthetic import NO_KEYFRAMES, apart, landmarks_at, preset_with

from ground_station.features.methods.rootsift import RootSift
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization import tracking
from ground_station.localization.attempt import Conditions
from ground_station.localization.estimate import State
from ground_station.localization.kinematics import Kinematics
from ground_station.localization.localizer import Localizer
from ground_station.localization.matching import Matcher
from ground_station.localization.settings import TrackingSettings, load_preset
from ground_station.localization.tracking import Keyframe, evenly_lit, spread_out, track
from ground_station.localization.worker import BESIDE_NICE, Worker
from ground_station.map.store import Map, MapInfo

DEPTH_M = 4.0


class Wall:
    """A textured wall 4 m ahead, and pictures of it through the thesis's lens."""

    def __init__(self, seed: int = 5) -> None:
        rng = np.random.default_rng(seed)
        self.camera = dataclasses.replace(THESIS_CAMERA, readout_s=0.0)
        self.texture = cv2.GaussianBlur(
            rng.uniform(0, 255, (1800, 2400)).astype(np.float32), (0, 0), 3
        )
        self.texture = cv2.normalize(self.texture, None, 0, 255, cv2.NORM_MINMAX)
        self.scale = 250.0
        self.taken: dict[bytes, np.ndarray] = {}
        rows, columns = np.mgrid[: self.camera.height_px, : self.camera.width_px]
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        self.rays = np.c_[self.camera.undistort(pixels), np.ones(len(pixels))]

    def on_wall(self, rays: np.ndarray, wTc: np.ndarray) -> np.ndarray:
        """Where rays (N, 3) of a camera at wTc meet the wall, (N, 3)."""
        turned = rays @ wTc[:3, :3].T
        return wTc[:3, 3] + turned * ((DEPTH_M - wTc[2, 3]) / turned[:, 2])[:, None]

    def picture(self, wTc: np.ndarray) -> np.ndarray:
        """The grey image (H, W) a camera at wTc takes."""
        if (key := wTc.tobytes()) not in self.taken:
            self.taken[key] = self._picture(wTc)
        return self.taken[key].copy()

    def _picture(self, wTc: np.ndarray) -> np.ndarray:
        where = self.on_wall(self.rays, wTc)[:, :2] * self.scale + [1200, 900]
        shape = (self.camera.height_px, self.camera.width_px)
        x, y = where.astype(np.float32).reshape(*shape, 2).transpose(2, 0, 1)
        return cv2.remap(self.texture, x, y, cv2.INTER_LINEAR).astype(np.uint8)

    def keyframe(self, wTc: np.ndarray, count: int = 200, seed: int = 1) -> Keyframe:
        rng = np.random.default_rng(seed)
        pixel = rng.uniform([60, 60], [580, 420], (count, 2)).astype(np.float32)
        rays = np.c_[self.camera.undistort(pixel), np.ones(count)]
        points = self.on_wall(rays, wTc)
        return Keyframe(0, self.picture(wTc), wTc, pixel, np.arange(count), points, np.ones(count))

    @cached_property
    def map(self) -> Map:
        """Landmarks from RootSIFT of one picture, each where its ray meets the wall."""
        wTc = np.eye(4)
        features = RootSift(1000).extract(self.picture(wTc))
        rays = np.c_[self.camera.undistort(features.keypoints_px), np.ones(len(features))]
        position = self.on_wall(rays, wTc)
        sift = RootSift()
        info = MapInfo(sift.name, sift.sha256, 128, self.camera, "wall", "world", "m")
        return Map(info, landmarks_at(position, features.descriptors), NO_KEYFRAMES)


@pytest.fixture(scope="module")
def wall():
    return Wall()


def path(count):
    """A smooth sway before the wall at 30 Hz: times (N,), ns, and poses (N, 4, 4)."""
    t = np.arange(count) / 30.0
    wTc = [
        poses.exp([0.02 * np.sin(2 * a), 0.05 * np.sin(a), 0.03 * a, 0.2 * a, 0.1 * a * a, 0.1 * a])
        for a in t
    ]
    return np.round(t * 1e9).astype(np.int64).tolist(), wTc


TIMES, TRUTH = path(60)


def make(wall, **tables):
    extractor = Counting()
    return Localizer(wall.map, wall.camera, extractor, preset_with(**tables)), extractor


class Counting(RootSift):
    """RootSIFT that remembers which threads it ran in."""

    def __init__(self):
        super().__init__(1000)
        self.threads = []

    def extract(self, image):
        self.threads.append(threading.current_thread().name)
        return super().extract(image)


def fly(localizer, wall, frames):
    """What becomes of some frames of the way."""
    return [localizer.process(TIMES[k], wall.picture(TRUTH[k]), k) for k in frames]


def started(wall):
    """A localizer that was told where it begins, and its extractor."""
    localizer, extractor = make(wall)
    localizer.set_initial_pose(TRUTH[0], TIMES[0])
    return localizer, extractor


@pytest.mark.parametrize(
    ("doubt_px", "levels"), [(0.0, 1), (2.5, 1), (2.6, 2), (5.1, 3), (50.0, 3), (np.nan, 3)]
)
def test_the_pyramid_is_as_high_as_the_predictions_doubt(wall, doubt_px, levels, monkeypatch):
    used = []
    follow = tracking._follow

    def noting(before, after, start, guess, settings):
        used.append(settings.levels)
        return follow(before, after, start, guess, settings)

    monkeypatch.setattr(tracking, "_follow", noting)
    keyframe = wall.keyframe(np.eye(4))
    image = wall.picture(poses.pose(np.eye(3), [0.02, 0.0, 0.0]))  # 2.5 px
    found = track(keyframe, image, np.eye(4), wall.camera, TrackingSettings(), doubt_px)
    # Back from where it was found, 0.7 px are guessed aside; closer, there and back.
    assert used == [levels, 1, 1, 1]
    assert len(found.point) > 0.95 * found.sought


def test_a_bump_that_no_prediction_doubted_is_followed_all_the_same(wall):
    image = wall.picture(poses.pose(np.eye(3), [0.08, 0.0, 0.0]))  # 10 px
    found = track(wall.keyframe(np.eye(4)), image, np.eye(4), wall.camera, TrackingSettings(), 0.5)
    assert len(found.point) > 0.95 * found.sought


def test_a_predictions_doubt_is_of_the_keyframes_own_points(wall):
    matcher = Matcher(wall.map, wall.camera, load_preset("default"))
    covariance = np.diag(np.r_[np.full(3, 1e-12), np.full(3, 0.01**2), np.full(6, 1.0)])
    expected = Kinematics(0, np.eye(4), np.zeros(6), covariance)
    points = wall.keyframe(np.eye(4)).points_m
    # 1 cm on each axis at 4 m, three deviations, along both axes of the picture.
    assert matcher.doubt_px(points, expected) == pytest.approx(3 * np.sqrt(2) * 1.26, rel=0.1)
    assert matcher.doubt_px(points * [1, 1, 0.25], expected) > 15
    assert matcher.doubt_px(points[:0], expected) == 0.0


def followed(wall, wTc, predicted, picture):
    """How far points are off where they were found again (N,), px, and how many were sought."""
    keyframe = wall.keyframe(np.eye(4))
    tracks = track(keyframe, picture, predicted, wall.camera, TrackingSettings())
    truth = wall.camera.project(poses.transform(poses.inverse(wTc), keyframe.points_m))
    return np.linalg.norm(tracks.pixel_px - truth[tracks.point], axis=1), tracks.sought


ASIDE = poses.exp([0.02, -0.03, 0.04, 0.1, -0.05, 0.1])
PREDICTED = ASIDE @ poses.exp([0.004, 0.004, 0.0, 0.01, 0.0, 0.0])


def test_points_are_found_where_the_wall_says_they_are(wall):
    off, sought = followed(wall, ASIDE, PREDICTED, wall.picture(ASIDE))
    assert len(off) > 0.9 * sought > 100
    assert np.median(off) < 0.1 and np.percentile(off, 95) < 0.5


@pytest.mark.parametrize(
    "moved",
    [[0, 0, 0, 0, 0, 1.2], [0, 0, 0, 0, 0, -1.2], [0, 0, 0.3, 0, 0, 0], [0, 0.3, 0, -1.2, 0, 0.8]],
    ids=["nearer", "farther", "rolled", "aslant"],
)
def test_points_are_followed_where_the_wall_looks_otherwise(wall, moved):
    wTc = poses.exp(moved)
    off, sought = followed(wall, wTc, wTc, wall.picture(wTc))
    assert len(off) > 0.95 * sought > 80
    assert np.median(off) < 0.06 and np.percentile(off, 95) < 0.3


def test_a_point_before_a_wall_farther_away_stays_where_it_is(wall):
    edge = 400  # the wall ends here: to the right of it another one, which moves by 3 px, is seen
    before, after = wall.picture(np.eye(4)), wall.picture(np.eye(4))
    behind = Wall(seed=6).picture(np.eye(4))
    before[:, edge:], after[:, edge:] = behind[:, edge:], behind[:, edge - 3 : -3]
    pixel = np.array([[edge - 5, y] for y in range(40, 440, 20)], np.float32)
    points = wall.on_wall(np.c_[wall.camera.undistort(pixel), np.ones(len(pixel))], np.eye(4))
    ones = np.ones(len(pixel))
    keyframe = Keyframe(0, before, np.eye(4), pixel, np.arange(len(pixel)), points, ones)
    tracks = track(keyframe, after, np.eye(4), wall.camera, TrackingSettings())
    off = np.linalg.norm(tracks.pixel_px - pixel[tracks.point], axis=1)
    assert len(off) == len(pixel) and np.median(off) < 0.1  # 0.7 px by KLT's window alone


def test_points_of_what_is_no_longer_there_are_dropped(wall):
    keyframe = wall.keyframe(np.eye(4))
    other = Wall(seed=6).picture(np.eye(4))
    tracks = track(keyframe, other, np.eye(4), wall.camera, TrackingSettings())
    assert tracks.sought == len(keyframe) and len(tracks.point) < 0.2 * tracks.sought


def below(row: int) -> np.ndarray:
    """The macroblocks (30, 40) of a picture of 640x480 from a row on."""
    damaged = np.zeros((30, 40), bool)
    damaged[row:] = True
    return damaged


def test_points_in_what_a_loss_took_are_neither_sought_nor_found(wall):
    keyframe, damaged = wall.keyframe(np.eye(4)), below(15)
    image = wall.picture(np.eye(4))
    whole = track(keyframe, image, np.eye(4), wall.camera, TrackingSettings())
    taken = Conditions(damaged=damaged)
    part = track(keyframe, image, np.eye(4), wall.camera, TrackingSettings(), taken=taken)
    above = int((keyframe.pixel_px[:, 1] < 240 - 10).sum())
    assert part.sought == above < whole.sought and len(part.point) > 0.95 * above
    # A point that is led into it by a wrong prediction, or comes out of it, is dropped, too.
    assert (part.pixel_px[:, 1] < 240 - 10).all()
    all_of_it = Conditions(damaged=below(0))
    assert track(
        keyframe, image, np.eye(4), wall.camera, TrackingSettings(), taken=all_of_it
    ).sought == 0  # fmt: skip


def test_what_a_picture_shows_ends_a_window_before_the_damage():
    taken = Conditions(damaged=below(15))
    pixels = np.array([[5, 229.9], [5, 230.1], [639, 100], [320, 400], [-40, -40], [np.nan, 0]])
    assert taken.shows(pixels, 10).tolist() == [True, False, True, False, True, True]
    assert Conditions().shows(pixels, 10).all()
    stripe = below(15) & ~below(16)
    assert Conditions(damaged=stripe).shows(np.array([[300.0, 220.0]]), 31).tolist() == [False]


def relit(picture: np.ndarray, light: float | np.ndarray, seed: int = 2) -> np.ndarray:
    """A picture (H, W) in that many times the light, a number or (H, 1), with a sensor's noise."""
    level = np.clip(light * (picture / 255.0) ** 2.2, 0, 1)
    noise = np.random.default_rng(seed).normal(0, 1, picture.shape)
    return np.clip(np.rint(255 * level ** (1 / 2.2) + noise), 0, 255).astype(np.uint8)


def bands(share: float) -> np.ndarray:
    """The light (H, 1) of a lamp of 100 Hz in rows read out within 20 ms."""
    return 1 + share * np.sin(2 * np.pi * 2 * np.arange(480)[:, None] / 480)


@pytest.mark.parametrize(
    "light",
    [2.0, 0.5, 0.25, 0.03, bands(0.4), bands(0.6)],
    ids=["+1 EV", "-1 EV", "-2 EV", "lights off", "flicker", "strong flicker"],
)
def test_points_are_followed_into_another_light(wall, light):
    off, sought = followed(wall, ASIDE, PREDICTED, relit(wall.picture(ASIDE), light))
    assert len(off) > 0.9 * sought > 100
    assert np.median(off) < 0.15 and np.percentile(off, 95) < 0.6


def test_gain_and_offset_leave_an_evenly_lit_picture_as_it_is(wall):
    picture = wall.picture(np.eye(4))
    even, changed = evenly_lit(picture), evenly_lit((0.5 * picture + 60).astype(np.uint8))
    assert even.shape == picture.shape and even.dtype == np.uint8
    assert 120 < even.mean() < 136 and 24 < even.std() < 36
    assert np.abs(even.astype(int) - changed).mean() < 4


def test_noise_is_no_contrast():
    noise = np.random.default_rng(4).normal(0, 1, (480, 640))
    even = evenly_lit(np.clip(np.rint(90 + noise), 0, 255).astype(np.uint8))
    assert 126 < even.mean() < 130 and even.std() < 8
    assert (evenly_lit(np.full((3, 2), 7, np.uint8)) == 128).all()


def test_points_out_of_view_are_not_sought(wall):
    keyframe = wall.keyframe(np.eye(4))
    away = poses.exp([0.0, np.pi, 0.0, 0.0, 0.0, 0.0])
    tracks = track(keyframe, keyframe.image, away, wall.camera, TrackingSettings())
    assert tracks.sought == 0 and len(tracks.point) == 0


def test_points_are_kept_evenly_and_the_best_first():
    rng = np.random.default_rng(3)
    crowd = rng.uniform([0, 0], [30, 30], (500, 2))
    rest = np.array([[100.0, 100.0], [400.0, 100.0], [100.0, 400.0]])
    chosen = spread_out(np.concatenate([crowd, rest]), 10)
    assert len(chosen) == 10 and {500, 501, 502, 0} <= set(chosen.tolist())
    assert spread_out(rest, 10).tolist() == [0, 1, 2]


def test_a_keyframe_of_fewer_points_keeps_the_best_of_each_part(wall):
    whole = wall.keyframe(np.eye(4)).first(40)
    crowd = np.tile([[100.0, 100.0]], (30, 1))  # the best, all at one place
    others = np.array([[50.0 * k, 300.0] for k in range(1, 11)])
    whole = replace(whole, pixel_px=np.concatenate([crowd, others]).astype(np.float32))
    few = whole.first(15)
    kept = [*range(5), *range(30, 40)]
    assert sorted(few.landmark) == sorted(whole.landmark[kept])
    at = [whole.landmark.tolist().index(one) for one in few.landmark]
    assert np.array_equal(few.pixel_px, whole.pixel_px[at])
    assert np.array_equal(few.points_m, whole.points_m[at])
    assert whole.first(40) is whole


def test_frames_in_between_are_tracked_as_well_as_described_ones(wall):
    localizer, extractor = started(wall)
    estimates = fly(localizer, wall, range(24))
    assert not estimates[0].tracked and all(e.tracked for e in estimates[1:])
    for estimate, wTc in zip(estimates, TRUTH, strict=False):
        assert estimate.state is State.TRACKING
        assert within(estimate, wTc)
    assert {"track", "pose", "total"} <= set(estimates[1].stage_ms)
    assert any("background" in e.stage_ms for e in estimates)
    assert estimates[5].counts.inliers == estimates[5].observations.inlier.sum()
    # One in the foreground, and the keyframes after it beside the frames.
    assert extractor.threads[0] == threading.current_thread().name
    assert len(extractor.threads) >= 3
    assert all(name.startswith("keyframes") for name in extractor.threads[1:])


def test_rest_makes_keyframes_rare_and_light_and_costs_no_pose(wall):
    described, seen = [], []
    for rest_s in (0.0, 1.0):
        localizer, extractor = started(wall)
        localizer.rest_s = rest_s
        estimates = fly(localizer, wall, range(60))
        assert all(e.state is State.TRACKING for e in estimates)
        assert all(within(e, wTc) for e, wTc in zip(estimates, TRUTH, strict=True))
        described.append(len(extractor.threads))
        seen.append(estimates[-1].counts.inliers)
    assert described[1] <= 3 and described[0] >= 2 * described[1]
    assert seen[1] <= localizer.settings.tracking.max_points // 4 < seen[0]


def test_the_same_frames_give_the_same_poses_again(wall):
    first, second = (fly(started(wall)[0], wall, range(24)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.wTc, b.wTc) and np.array_equal(a.covariance, b.covariance)


def test_neither_exposure_nor_light_nor_flicker_is_a_reason_to_lose_a_frame(wall):
    localizer, _ = started(wall)
    light = [2.0, 0.5, 1.0, 0.02, 1.0]  # of eight frames each
    for k in range(40):
        flicker = np.roll(bands(0.4), 160 * k, axis=0)
        picture = relit(wall.picture(TRUTH[k]), light[k // 8] * flicker, seed=k)
        estimate = localizer.process(TIMES[k], picture, k)
        assert estimate.state is State.TRACKING, (k, estimate.reason)
        assert within(estimate, TRUTH[k])


def within(estimate, wTc):
    metres, radians = apart(estimate.wTc, wTc)
    return metres < 0.01 and radians < 0.003


def a_hand() -> np.ndarray:
    """What shows something, and nothing of the map."""
    coarse = np.random.default_rng(3).integers(60, 120, (6, 8)).astype(np.uint8)
    return cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def tracking_it(wall):
    """A localizer that has tracked for eight frames, and its extractor."""
    localizer, extractor = started(wall)
    fly(localizer, wall, range(8))
    return localizer, extractor


def test_a_black_frame_is_skipped_and_the_next_is_followed_again(wall, tracking_it):
    localizer, extractor = tracking_it
    black = localizer.process(TIMES[8], np.zeros((480, 640), np.uint8), 8)
    assert black.gated and not black.localized and black.state is State.DEGRADED
    (back,) = fly(localizer, wall, [9])
    assert back.localized and back.tracked and back.state is State.DEGRADED
    assert extractor.threads.count(threading.current_thread().name) == 1


def test_a_damaged_frame_is_followed_by_what_is_left_of_it(wall, tracking_it):
    localizer, extractor = tracking_it
    image, noise = wall.picture(TRUTH[8]), np.random.default_rng(1)
    image[240:] = noise.integers(0, 255, image[240:].shape)
    part = localizer.process(TIMES[8], image, 8, damaged=below(15))
    assert part.localized and part.tracked and part.state is State.TRACKING
    assert (part.observations.pixel_px[:, 1] < 230).all()
    assert np.linalg.norm(part.wTc[:3, 3] - TRUTH[8][:3, 3]) < 0.01
    # All of it gone: nothing is found, and nothing is looked for.
    described = len(extractor.threads)
    gone = localizer.process(TIMES[9], image, 9, damaged=below(0))
    assert not gone.localized and gone.state is State.DEGRADED
    assert len(extractor.threads) == described


def test_a_place_is_found_in_whole_frames_only(wall):
    localizer, extractor = make(wall)
    for k in range(6):
        seen = localizer.process(TIMES[k], wall.picture(TRUTH[k]), k, damaged=below(25))
        assert not seen.localized and seen.state is State.INITIALIZING
    assert extractor.threads == []
    # And the first of these is searched at once, as the first of a stream is.
    (whole,) = fly(localizer, wall, [6])
    assert whole.relocalized and extractor.threads == [threading.current_thread().name]


def test_a_strange_frame_is_searched_beside_and_the_next_is_followed_again(wall, tracking_it):
    localizer, extractor = tracking_it
    strange = localizer.process(TIMES[8], a_hand(), 8)
    assert not strange.localized and not strange.tracked and strange.state is State.DEGRADED
    assert "features" not in strange.stage_ms and "points found" in strange.reason
    back, after = fly(localizer, wall, [9, 10])
    assert back.localized and back.tracked and back.state is State.DEGRADED
    assert back.reason.startswith("just recovered")
    assert after.state is State.TRACKING
    assert extractor.threads.count(threading.current_thread().name) == 1


@pytest.mark.parametrize("covered", ["dark", "a hand"])
def test_what_was_lost_is_found_beside_the_frames_and_after_the_dark_at_once(wall, covered):
    localizer, extractor = started(wall)
    cover = np.zeros((480, 640), np.uint8) if covered == "dark" else a_hand()
    pictures = [cover if 10 <= k < 27 else wall.picture(TRUTH[k]) for k in range(60)]
    frames = [localizer.process(TIMES[k], pictures[k], k) for k in range(60)]
    states = [frame.state for frame in frames]
    assert State.LOST not in states[:15] and set(states[22:27]) == {State.LOST}
    found = next(k for k in range(27, 60) if frames[k].localized)
    assert frames[found].relocalized and (found == 27 if covered == "dark" else found < 42)
    # The wall leaves no doubt; but that a camera gets anywhere in the dark does.
    sure = states.index(State.TRACKING, 27)
    assert found <= sure < 54 and all(state is State.TRACKING for state in states[sure:])
    for k in range(found, 60):
        assert np.linalg.norm(frames[k].wTc[:3, 3] - TRUTH[k][:3, 3]) < 0.02
    here = extractor.threads.count(threading.current_thread().name)
    assert here == (2 if covered == "dark" else 1)
    described = {k for k, frame in enumerate(frames) if "features" in frame.stage_ms}
    assert described == ({0, 27} if covered == "dark" else {0})


def test_a_weak_relocalization_is_not_confirmed_by_its_own_points(wall):
    localizer, _ = make(wall, state={"sure_significance": 1e9})
    frames = fly(localizer, wall, range(14))
    assert frames[0].relocalized and all(frame.tracked for frame in frames[1:])
    landed = next(k for k, frame in enumerate(frames) if "background" in frame.stage_ms)
    assert landed >= 4
    for frame in frames[:landed]:
        assert frame.state is State.DEGRADED and "to be confirmed" in frame.reason
    assert frames[-1].state is State.TRACKING


def test_frames_far_apart_are_described_themselves(wall):
    localizer, extractor = make(wall)
    frames = fly(localizer, wall, range(0, 31, 6))
    assert all(frame.localized and not frame.tracked for frame in frames)
    assert len(extractor.threads) == len(frames)


def test_a_time_that_jumps_back_is_refused_while_tracking(wall):
    *_, refused, after = fly(started(wall)[0], wall, [0, 1, 2, 1, 3])
    assert refused.reason.startswith("refused") and refused.wTc is None
    assert after.tracked


def test_the_thread_beside_the_tracking_steps_aside():
    """Both want the same core when a machine has two: the frame goes first."""
    worker: Worker[int] = Worker(0.1)
    worker.submit(lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), 0)
    mine = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert worker.collect(1_000_000_000) == min(mine + BESIDE_NICE, 19)
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == mine


def test_a_result_lands_at_its_frame_and_is_waited_for():
    worker: Worker[int] = Worker(0.3)
    release = threading.Event()
    s = 1_000_000_000
    worker.submit(lambda: 7 if release.wait(10) else 0, 5 * s)
    assert worker.collect(5 * s + s // 5) is None and worker.busy
    release.set()
    assert worker.collect(5 * s + s // 5) is None and worker.busy
    assert worker.collect(6 * s) == 7 and not worker.busy and worker.collect(7 * s) is None


def test_without_a_lag_nothing_is_waited_for():
    worker: Worker[int] = Worker(0)
    release, done = threading.Event(), threading.Event()

    def job() -> int:
        release.wait(10)
        return 7

    worker.submit(job, 0)
    assert worker.collect(1) is None and worker.busy
    release.set()
    for _ in range(1000):
        if (result := worker.collect(2)) is not None or done.wait(0.01):
            break
    assert result == 7


def test_what_a_job_raised_is_raised_where_it_lands_and_a_dropped_one_never():
    worker: Worker[int] = Worker(0.1)
    worker.submit(lambda: 1 // 0, 0)
    with pytest.raises(ZeroDivisionError):
        worker.collect(1_000_000_000)
    worker.submit(lambda: 1 // 0, 0)
    worker.drop()
    assert not worker.busy and worker.collect(1_000_000_000) is None


def test_what_tells_no_view_leaves_the_keyframe_as_it_is(wall):
    image = wall.picture(np.eye(4))
    line = np.linspace([60, 240], [580, 240], 20, dtype=np.float32)
    rng = np.random.default_rng(3)
    for start, aim in [
        (line[:4], line[:4] + 5),  # too few
        (line, line + np.float32([0, 5])),  # one line
        (line, np.full_like(line, 7)),  # one place
        (line, rng.uniform(0, 480, line.shape).astype(np.float32)),  # anywhere
    ]:
        template, there = tracking._bent(image, start, aim, 21)
        assert template is image and there is start
