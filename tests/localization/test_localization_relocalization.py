"""A frame is found in the map it belongs to, and in no other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from synthetic import apart, keyframes_of, unit_rows

from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.geometry.camera import THESIS_CAMERA
from ground_station.localization import relocalization
from ground_station.localization.attempt import Conditions
from ground_station.localization.matching import describe
from ground_station.localization.relocalization import (
    Relocalization,
    Relocalizer,
    pose_from_matches,
)
from ground_station.localization.retrieval import PlaceIndex
from ground_station.localization.settings import load_preset
from ground_station.map.store import Landmarks, Map

SETTINGS = load_preset("default").recovery


def observed(map_: Map, wTc: np.ndarray, most: int = 300) -> np.ndarray:
    """Landmarks in view of a pose, the first of them."""
    points = poses.transform(poses.inverse(wTc), map_.landmarks.position_m)
    pixels = THESIS_CAMERA.project(points)
    flat = np.abs(points[:, :2] / np.maximum(points[:, 2:], 1e-3))
    inside = (points[:, 2] > 0.1) & (flat < 0.9).all(axis=1)
    inside &= ((pixels >= 0) & (pixels <= [639, 479])).all(axis=1)
    return np.flatnonzero(inside)[:most].astype(np.int32)


def with_keyframes(map_: Map, wTc: np.ndarray) -> Map:
    """The map as if it had been made from frames at these poses (K, 4, 4)."""
    return replace(map_, keyframes=keyframes_of(wTc, [observed(map_, pose) for pose in wTc]))


def twice(map_: Map, aside_m: float) -> Map:
    """Two buildings with the same landmarks."""
    lm, kf = map_.landmarks, map_.keyframes
    both = {f.name: np.concatenate([getattr(lm, f.name)] * 2) for f in fields(Landmarks)}
    both["position_m"][len(lm) :] += [aside_m, 0, 0]
    wTc = kf.wTc.copy()
    wTc[:, :3, 3] += [aside_m, 0, 0]
    seen = np.split(kf.landmark, kf.offset[1:-1])
    keyframes = keyframes_of(np.concatenate([kf.wTc, wTc]), [*seen, *(s + len(lm) for s in seen)])
    return replace(map_, landmarks=Landmarks(**both), keyframes=keyframes)


@dataclass
class Building:
    """A mapped room, and places in it where no keyframe was."""

    map: Map
    path: np.ndarray
    features: Callable[..., Features]


@pytest.fixture
def building(room) -> Building:
    _, path = room.path(540)
    return Building(with_keyframes(room.map, path[::12]), path[6::60], room.features)


def find(map_: Map, features: Features) -> Relocalization | str:
    relocalizer = Relocalizer(map_, THESIS_CAMERA, SETTINGS, 0)
    found = relocalizer.candidates(describe(features, THESIS_CAMERA, Conditions()))
    return found if isinstance(found, str) else relocalizer.alone(found)


def off_m(found: Relocalization | str, truth: np.ndarray) -> float:
    assert isinstance(found, Relocalization), found
    return apart(found.wTc, truth)[0]


def strangers(like: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many descriptors of what nobody has seen before."""
    return unit_rows(rng, *like.shape)


def test_the_right_place_is_found_among_sixty_percent_outliers(building):
    for wTc in building.path:
        found = find(building.map, building.features(wTc, outliers=0.6))
        assert off_m(found, wTc) < 0.03 and apart(found.wTc, wTc)[1] < np.radians(0.3)


def test_a_frame_that_shares_nothing_with_the_map_is_refused(building):
    rng = np.random.default_rng(3)
    for wTc in building.path[:4]:
        features = building.features(wTc)
        foreign = replace(features, descriptors=strangers(features.descriptors, rng))
        assert isinstance(find(building.map, foreign), str)
    empty = Features(
        np.empty((0, 2), np.float32), np.empty(0, np.float32), features.descriptors[:0]
    )
    assert find(building.map, empty) == "no features"


def test_known_things_in_another_arrangement_are_refused(building):
    rng = np.random.default_rng(4)
    for wTc in building.path[:4]:
        features = building.features(wTc)
        shuffled = rng.permutation(features.keypoints_px)
        assert isinstance(find(building.map, replace(features, keypoints_px=shuffled)), str)


def test_one_known_poster_in_another_building_is_no_place(building):
    # A small patch matches perfectly, the rest of the view is something else.
    for wTc in building.path[:4]:
        features = building.features(wTc, outliers=0.0)
        centre = np.median(features.keypoints_px, axis=0)
        known = np.linalg.norm(features.keypoints_px - centre, axis=1) < 80
        other = strangers(features.descriptors, np.random.default_rng(5))
        descriptors = np.where(known[:, None], features.descriptors, other)
        assert known.sum() >= 12
        assert isinstance(find(building.map, replace(features, descriptors=descriptors)), str)


def test_what_is_seen_of_one_thing_says_less_than_as_much_all_over_the_picture(building):
    """A door like many fills a few cells of the picture, and its landmarks come together."""
    camera = replace(THESIS_CAMERA, readout_s=0.0)  # nothing is refused as open
    # Of landmarks as sparse as these few fill a cell: fewer must do, and nothing else refuses them.
    judging = replace(SETTINGS, min_inliers=15, min_spread=0.0, min_excess=0.02)
    believing = replace(judging, min_evenness=0.0)
    for wTc in building.path[[0, 3]]:
        features = building.features(wTc, outliers=0.0)
        aside = np.linalg.norm(features.keypoints_px - [320, 240], axis=1)
        nearest, anywhere = np.argsort(aside), np.random.default_rng(6).permutation(len(aside))
        for known, count, settings, is_found in (
            (nearest, 36, judging, False),
            (nearest, 36, believing, True),
            (anywhere, 36, judging, True),
            (nearest, 200, judging, True),
        ):
            descriptors = strangers(features.descriptors, np.random.default_rng(5))
            kept = known[:count]
            descriptors[kept] = features.descriptors[kept]
            partly = replace(features, descriptors=descriptors)
            relocalizer = Relocalizer(building.map, camera, settings, 0)
            found = relocalizer.candidates(describe(partly, camera, Conditions()))
            assert not isinstance(found, str), found
            assert isinstance(relocalizer.alone(found), Relocalization) == is_found


def test_of_two_equal_places_neither_is_believed(building):
    double = twice(building.map, 20.0)
    for wTc in building.path[:4]:
        found = find(double, building.features(wTc))
        assert isinstance(found, str) and "fit alike" in found


def test_of_two_equal_places_both_are_named_for_who_knows_more(building):
    """A prediction may decide what the picture alone does not."""
    double = twice(building.map, 20.0)
    relocalizer = Relocalizer(double, THESIS_CAMERA, SETTINGS, 0)
    for wTc in building.path[:4]:
        seen = describe(building.features(wTc), THESIS_CAMERA, Conditions())
        found = relocalizer.candidates(seen)
        assert len(found) > 1 and min(off_m(one, wTc) for one in found) < 0.03
        assert "fit alike" in relocalizer.alone(found)


def test_a_few_landmarks_are_named_but_not_believed_by_themselves(building):
    relocalizer = Relocalizer(building.map, THESIS_CAMERA, SETTINGS, 0)
    rng = np.random.default_rng(8)
    for wTc in building.path[:4]:
        features = building.features(wTc)
        other = strangers(features.descriptors, rng)
        few = rng.permutation(len(features)) < 24
        mixed = np.where(few[:, None], features.descriptors, other)
        faint = replace(features, descriptors=mixed)
        found = relocalizer.candidates(describe(faint, THESIS_CAMERA, Conditions()))
        assert not isinstance(found, str) and all(one.doubt for one in found)
        assert off_m(found[0], wTc) < 0.1
        assert "landmarks where they should be" in str(relocalizer.alone(found))


def test_what_is_left_open_is_refused_only_where_a_shutter_may_shear_it(building):
    features = building.features(building.path[0])
    found = find(building.map, features)
    assert isinstance(found, Relocalization)
    far = replace(found, open_by=0.02)

    def believed(readout_s: float, turn_deg_s: float = 40.0) -> Relocalization | str:
        camera = replace(THESIS_CAMERA, readout_s=readout_s)
        relocalizer = Relocalizer(building.map, camera, SETTINGS, 0, turn_deg_s=turn_deg_s)
        return relocalizer.alone([far])

    assert "open by 2.0%" in str(believed(0.02)) and believed(0.005) is far
    assert believed(0.02, turn_deg_s=10.0) is far and believed(0.0) is far


def test_what_differs_between_two_alike_places_decides(building):
    double = twice(building.map, 20.0)
    rng = np.random.default_rng(6)
    own = double.landmarks.descriptor[len(building.map.landmarks) :]
    changed = rng.random(len(own)) < 0.6
    own[changed] = strangers(own[changed], rng)
    for wTc in building.path[:4]:
        assert off_m(find(double, building.features(wTc)), wTc) < 0.03


def test_where_the_most_alike_keyframes_are_all_wrong_the_map_is_searched(building, monkeypatch):
    ranked = PlaceIndex.ranked
    monkeypatch.setattr(PlaceIndex, "ranked", lambda *args: ranked(*args)[::-1])
    for wTc in building.path[:4]:
        assert off_m(find(building.map, building.features(wTc)), wTc) < 0.03
        with monkeypatch.context() as narrow:
            narrow.setattr(relocalization, "_WIDE", 24)
            assert isinstance(find(building.map, building.features(wTc)), str)


def test_the_same_frame_and_seed_give_the_same_answer(building):
    features = building.features(building.path[1], outliers=0.5)
    one, other = find(building.map, features), find(building.map, features)
    assert isinstance(one, Relocalization) and isinstance(other, Relocalization)
    assert np.array_equal(one.wTc, other.wTc) and np.array_equal(one.landmark, other.landmark)


def test_the_keyframes_nearest_to_the_frame_rank_first(building):
    index = PlaceIndex(building.map.landmarks, building.map.keyframes, 0)
    for wTc in building.path:
        ranked = index.ranked(building.features(wTc, outliers=0.6).descriptors, 5)
        forward = building.map.keyframes.wTc[ranked[0], :3, 2]
        assert forward @ wTc[:3, 2] > np.cos(np.radians(20))


def test_the_words_find_most_of_what_a_search_of_everything_finds(building):
    index = PlaceIndex(building.map.landmarks, building.map.keyframes, 0)
    descriptors = building.features(building.path[0], outliers=0.0).descriptors
    landmark, cosine = index.nearest(descriptors)
    products = descriptors @ building.map.landmarks.descriptor.T
    assert (landmark[:, 0] == products.argmax(axis=1)).mean() > 0.9
    assert np.allclose(cosine, np.take_along_axis(products, landmark, axis=1), atol=1e-5)
    assert (cosine[:, 0] >= cosine[:, 1]).all() and (landmark[:, 0] != landmark[:, 1]).all()


def test_a_pose_is_proposed_by_all_that_is_right_and_not_by_the_luckiest():
    """Few of the landmarks are right, near each other in the picture and known to a centimetre:
    within 3 px of a pose from three of them are not all, and those around it are as many."""
    camera, off_m = THESIS_CAMERA, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        right = rng.uniform([180, 120], [460, 360], (21, 2))
        other = rng.uniform([0, 0], [camera.width_px, camera.height_px], (49, 2))
        depth_m = rng.uniform(2.0, 2.8, 70)
        rays = np.c_[np.r_[right, other], np.ones(70)] @ np.linalg.inv(camera.matrix).T
        points = rays * depth_m[:, None]
        points[:21] += rng.normal(0, 0.01, (21, 3))
        pixel = np.r_[right, rng.permutation(other)]
        found = pose_from_matches(points, pixel, camera, SETTINGS, seed)
        off_m.append(np.linalg.norm(found[0][:3, 3]) if found else np.inf)
    assert np.median(off_m) < 0.035
