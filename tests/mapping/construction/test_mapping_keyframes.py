"""Keyframes are spaced by motion, sharp, and no more than wanted; cuts and blur lose nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from panning import CAMERA, Place
from scipy.spatial.transform import Rotation

from ground_station.errors import MapError
from ground_station.mapping.construction.keyframes import choose, measure, relative_sharpness
from ground_station.mapping.construction.motion import Figures, Motion, best_rotation, sharpness
from ground_station.mapping.settings import KeyframeSettings
from ground_station.recording.frames import Frame

SETTINGS = KeyframeSettings(parallax_deg=2.0, turn_deg=8.0, lost=0.4, min_sharpness=0.65)


def figures(motion, sharp=None, segment=None, followed=None) -> Figures:
    n = len(motion)
    return Figures(
        index=np.arange(n) + 100,  # a range that begins at 100
        time_ns=np.arange(n) * 33_333_333,
        motion=np.array(motion, float),
        sharpness=np.ones(n) if sharp is None else np.array(sharp, float),
        segment=np.zeros(n, int) if segment is None else np.array(segment),
        followed=np.ones(n, bool) if followed is None else np.array(followed),
    )


def chosen(figure: Figures, most: int = 1000) -> list[int]:
    return (choose([figure], most, SETTINGS).index[0] - 100).tolist()


def test_a_hovering_camera_gives_one_keyframe_and_a_moving_one_evenly_many() -> None:
    moving = np.linspace(0, 10, 201)
    rows = chosen(figures([0.0] * 300 + moving.tolist() + [10.0] * 300))
    assert len(rows) == 11
    at = np.concatenate([np.zeros(300), moving, np.full(300, 10.0)])[rows]
    assert np.abs(at - np.arange(11)).max() <= 0.25


def test_of_the_frames_near_the_due_moment_the_sharpest_is_taken() -> None:
    rng = np.random.default_rng(1)
    motion = np.linspace(0, 8, 161)
    sharp = rng.uniform(0.8, 1.0, 161)
    rows = chosen(figures(motion, sharp))
    for m, row in enumerate(rows):
        near = np.abs(motion - m) <= 0.25
        assert sharp[row] == sharp[near].max()


def test_a_blurred_stretch_is_left_out_where_its_neighbours_link_and_else_counted() -> None:
    motion = np.linspace(0, 8, 161)
    sharp = np.ones(161)
    short = (motion > 3.45) & (motion < 4.55)
    rows = chosen(figures(motion, np.where(short, 0.4, sharp)))
    assert len(rows) == 8 and not short[rows].any()
    # Faster, so that it has frames beyond its neighbours' reach: here it must be bridged.
    motion = np.concatenate([np.linspace(0, 3, 61), [4, 5, 6, 7], np.linspace(8, 11, 61)])
    sharp = np.r_[np.ones(61), np.full(4, 0.4), np.ones(61)]
    keyframes = choose([figures(motion, sharp)], 1000, SETTINGS)
    assert keyframes.blurred == 4
    assert set(range(61, 65)) <= set((keyframes.index[0] - 100).tolist())


def test_a_blurred_end_is_left_out() -> None:
    motion = np.linspace(0, 5, 101)
    rows = chosen(figures(motion, np.where(motion > 4.45, 0.3, 1.0)))
    assert motion[rows].max() < 4.46 and len(rows) == 5


@pytest.mark.parametrize("most", [2, 7, 20, 40])
def test_too_many_are_thinned_by_motion(most: int) -> None:
    # Slow in the first half of the time, ten times as fast in the second.
    motion = np.concatenate([np.linspace(0, 9, 500), np.linspace(9, 99, 500)])
    keyframes = choose([figures(motion)], most, SETTINGS)
    rows = keyframes.index[0] - 100
    assert keyframes.due == 100 and most - 1 <= len(keyframes) <= most
    assert keyframes.spacing == pytest.approx(99 / (most - 0.5), rel=0.35)
    steps = np.diff(motion[rows])
    assert steps.max() < 1.7 * keyframes.spacing
    assert most == 2 or (rows < 500).mean() < 0.2  # half of them, were it by time


def test_every_cut_and_every_single_photograph_begins_a_keyframe() -> None:
    photographs = figures(np.arange(6.0), segment=np.arange(6))
    assert chosen(photographs) == [0, 1, 2, 3, 4, 5]
    assert len(chosen(photographs, most=3)) == 3


def test_inputs_share_the_limit_by_their_motion() -> None:
    slow, fast = figures(np.linspace(0, 20, 900)), figures(np.linspace(0, 60, 300))
    keyframes = choose([slow, fast], 40, SETTINGS)
    few, many = map(len, keyframes.index)
    assert 38 <= few + many <= 40
    assert many / few == pytest.approx(3, rel=0.2)


def test_frames_that_could_not_be_followed_are_never_sharp() -> None:
    followed = np.ones(40, bool)
    followed[20] = False
    assert relative_sharpness(figures(np.zeros(40), followed=followed))[20] == 0


def test_the_rotation_is_found_through_outliers_and_what_it_leaves_is_parallax() -> None:
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(100, 3)) * [0.4, 0.3, 0.0] + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R = Rotation.from_rotvec([0.02, 0.1, -0.05])
    turned = R.apply(rays)
    turned[:25] = Rotation.from_rotvec([0.0, 0.3, 0.0]).apply(turned[:25])  # a door that opens
    turn, left = best_rotation(rays, turned)
    assert turn == pytest.approx(R.magnitude(), abs=1e-3)
    assert np.median(left) < 1e-3 and left[:25].min() > 0.1


def flight(pictures) -> Figures:
    motion = Motion(CAMERA, SETTINGS)
    for k, image in enumerate(pictures):
        motion.add(k, k * 33_333_333, image)
    return motion.figures()


def test_a_turn_and_a_step_sideways_are_measured() -> None:
    place = Place(1)
    turned = flight(place.picture(yaw_deg=a) for a in np.arange(0, 16.1, 1.0))
    assert turned.motion[-1] == pytest.approx(2.0, abs=0.35)  # 16° of 8°
    assert np.diff(turned.motion).min() >= 0 and turned.followed.all()
    moved = flight(place.picture(x_m=x) for x in np.arange(0, 0.61, 0.05))
    # From 3 m and 6 m, 0.6 m are 11.3° and 5.7°: of what no rotation explains, 2.8° stay if it fits
    # both alike, and 5.6° for one of them if it fits the other.
    assert 2.8 / 2.0 - 0.2 < moved.motion[-1] < 5.6 / 2.0 + 0.3
    still = flight(place.picture() for _ in range(5))
    assert still.motion[-1] < 0.05


def test_blurred_and_blank_frames_cut_nothing_and_are_not_chosen() -> None:
    place = Place(2)
    pictures = [place.picture(x_m=0.03 * k) for k in range(30)]
    pictures[9] = place.picture(x_m=0.27, blur_px=60)
    pictures[14] = np.full_like(pictures[0], 90)
    found = flight(pictures)
    assert found.segment.max() == 0
    rows = choose([found], 100, SETTINGS).index[0].tolist()
    assert not {9, 14} & set(rows) and len(rows) >= 2
    assert relative_sharpness(found)[9] < 0.65


def test_a_cut_begins_a_segment_and_unordered_photographs_are_all_taken() -> None:
    first, second = Place(3), Place(4)
    pictures = [first.picture(x_m=0.02 * k) for k in range(12)]
    found = flight(pictures + [second.picture(x_m=0.02 * k) for k in range(12)])
    assert found.segment.tolist() == [0] * 12 + [1] * 12
    assert found.motion[12] - found.motion[11] > 0.5
    rows = choose([found], 100, SETTINGS).index[0]
    assert (rows < 12).any() and (rows >= 12).any()
    photographs = flight(Place(10 + k).picture() for k in range(8))
    assert choose([photographs], 100, SETTINGS).index[0].tolist() == list(range(8))


def test_a_blank_input_gives_its_one_picture() -> None:
    blank = flight([np.full((240, 320), 80, np.uint8)] * 6)
    assert len(choose([blank], 10, SETTINGS)) == 1


def test_sharpness_does_not_see_brightness_or_contrast_but_blur() -> None:
    image = Place(5).picture()
    darker = (image * 0.5 + 10).astype(np.uint8)
    assert sharpness(darker) == pytest.approx(sharpness(image), rel=0.03)
    assert sharpness(Place(5).picture(blur_px=9)) < 0.7 * sharpness(image)
    assert sharpness(np.full((20, 20), 7, np.uint8)) == 0


def test_a_frame_of_another_size_is_refused_by_its_name() -> None:
    frame = Frame(0, "a.png", 0, np.zeros((480, 640), np.uint8))
    with pytest.raises(MapError, match=r"^a.png: is 640x480 pixels, the camera 320x240: use"):
        measure([frame], CAMERA, dataclasses.replace(SETTINGS))
