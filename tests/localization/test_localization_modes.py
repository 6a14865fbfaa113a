"""A landmark that looks otherwise in another light is found by either look, and is one landmark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import all_compared, keyframes_of, landmarks_at, unit, unit_rows

from ground_station.experiments.disturbances.scale import Scale
from ground_station.features.extractor import Features
from ground_station.geometry import poses
from ground_station.localization.association import associate
from ground_station.localization.estimate import State
from ground_station.localization.localizer import Localizer
from ground_station.localization.relocalization import match_all
from ground_station.localization.retrieval import PlaceIndex
from ground_station.localization.settings import AssociationSettings, load_preset
from ground_station.localization.verification import Witness
from ground_station.map.modes import Modes, described


def _distances(features, landmarks, modes):
    """Of each feature from the nearest look of each landmark (F, L), in double precision."""
    apart = np.linalg.norm(features[:, None].astype(float) - landmarks[None], axis=2)
    for row, m in enumerate(modes.landmark):
        further = np.linalg.norm(features.astype(float) - modes.descriptor[row], axis=1)
        apart[:, m] = np.minimum(apart[:, m], further)
    return apart


def _modes(rng, landmarks, count, dimension=64):
    """Of random landmarks, up to three each; some are nearly what the landmark has already."""
    of = np.sort(np.repeat(rng.permutation(landmarks)[:count], rng.integers(1, 4, count)))
    return of.astype(np.int32), unit_rows(rng, len(of), dimension)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    ratio=st.sampled_from([1.0, 0.9, 0.6]),
    radius=st.sampled_from([20.0, 200.0]),
    dimension=st.sampled_from([32, 256]),
)
def test_association_compares_landmarks_and_not_their_looks(seed, ratio, radius, dimension):
    rng = np.random.default_rng(seed)
    ld = unit_rows(rng, 60, dimension)
    of, looks = _modes(rng, 60, 20, dimension)
    looks[::3] = ld[of[::3]] + 0.01 * looks[::3]  # nearly the same twice: never rivals
    modes = Modes(of, unit(looks))
    lp = rng.uniform(0, 300, (60, 2))
    rows, mode = described(ld, modes, np.arange(60))
    shows = np.concatenate([np.arange(60), mode])
    own = rng.integers(0, len(rows), 50)
    fd = unit(rows[own] + rng.normal(0, 0.5 / np.sqrt(dimension), (50, dimension)))
    fp = lp[shows[own]] + rng.normal(0, 0.4 * radius, (50, 2))
    options = AssociationSettings(max_ratio=ratio)
    limit = rng.uniform(0.4, 0.9)
    found = associate(fp, fd, lp[shows], rows, options, radius, limit, shows=shows)

    near = np.linalg.norm(fp[:, None] - lp[None], axis=2) <= radius
    pairs = list(zip(found.feature.tolist(), found.candidate.tolist(), strict=True))
    assert pairs == all_compared(_distances(fd, ld, modes), near, limit, ratio)


@pytest.mark.parametrize("ratio", [1.0, 0.8])
def test_a_search_of_everything_compares_landmarks_and_not_their_looks(ratio):
    rng = np.random.default_rng(3)
    ld = unit_rows(rng, 300)
    of, looks = _modes(rng, 300, 120)
    looks[::3] = ld[of[::3]]
    modes = Modes(of, looks)
    index = np.arange(300)
    rows, mode = described(ld, modes, index)
    own = rng.integers(0, len(rows), 200)
    fd = unit(rows[own] + rng.normal(0, 0.05, (200, 64)))
    feature, landmark = match_all(fd, rows, ratio, mode)
    distance = _distances(fd, ld, modes)
    expected = [
        (i, j)
        for i, j in enumerate(distance.argmin(axis=1).tolist())
        if distance[:, j].argmin() == i and distance[i, j] < ratio * np.delete(distance[i], j).min()
    ]
    assert list(zip(feature.tolist(), landmark.tolist(), strict=True)) == expected
    assert len(expected) > 100


def test_the_place_index_finds_landmarks_by_any_look_and_never_one_twice():
    rng = np.random.default_rng(4)
    ld = unit_rows(rng, 500)
    of, looks = _modes(rng, 500, 200)
    modes = Modes(of, looks)
    landmarks = landmarks_at(np.zeros((500, 3)), ld)
    index = PlaceIndex(landmarks, keyframes_of(np.eye(4)[None], [np.arange(500)]), 0, modes)
    rows, mode = described(ld, modes, np.arange(500))
    shows = np.concatenate([np.arange(500), mode])
    fd = unit(rows + 0.03 * rng.normal(size=rows.shape))
    best, cosine = index.nearest(fd)
    assert (best[:, 0] == shows).mean() > 0.97
    found = cosine[:, 1] > -1
    assert (best[found, 0] != best[found, 1]).all()
    right = best[:, 0] == shows
    assert np.allclose(cosine[right, 0], np.sum(fd * rows, axis=1)[right], atol=1e-5)


def _other_light(room, share=1.0):
    """The room's map with other looks of some landmarks, and what it looks like then."""
    lm = room.map.landmarks
    rng = np.random.default_rng(9)
    of = np.flatnonzero(rng.random(len(lm)) < share).astype(np.int32)
    looks = unit_rows(rng, len(of))
    then = np.array(lm.descriptor)
    then[of] = looks
    dark = replace(room, map=replace(room.map, landmarks=replace(lm, descriptor=then)))
    return replace(room.map, modes=Modes(of, looks)), dark


def _fly(map_, room, extractor, source, count=12):
    localizer = Localizer(map_, room.camera, extractor, load_preset("default"))
    times, truth = room.path(count)
    localizer.set_initial_pose(truth[0], int(times[0]))
    return [
        (localizer.process_features(int(t), source.features(T)), T)
        for t, T in zip(times, truth, strict=True)
    ]


def test_a_frame_in_another_light_is_localized_by_modes_alone(room, extractor):
    both, dark = _other_light(room)
    found = _fly(both, room, extractor, dark)
    assert all(e.state is State.TRACKING for e, _ in found[3:])
    for estimate, truth in found:
        assert np.linalg.norm(estimate.wTc[:3, 3] - truth[:3, 3]) < 0.03
    assert not any(e.localized for e, _ in _fly(room.map, room, extractor, dark))


def test_it_is_found_in_the_whole_map_by_modes_alone(room, extractor):
    both, dark = _other_light(room)
    localizer = Localizer(both, room.camera, extractor, load_preset("default"))
    times, truth = room.path(4)
    found = [
        localizer.process_features(int(t), dark.features(T))
        for t, T in zip(times, truth, strict=True)
    ]
    assert found[0].relocalized
    assert np.linalg.norm(found[0].wTc[:3, 3] - truth[0, :3, 3]) < 0.05


def test_modes_that_nothing_looks_like_change_no_pose(room, extractor):
    """By other features than any that is seen: the same pairs, the same poses, bit for bit."""
    both, _ = _other_light(room, share=0.4)
    plain, more = (
        _fly(map_, replace(room, rng=np.random.default_rng(1)), extractor,
             replace(room, rng=np.random.default_rng(1)))
        for map_ in (room.map, both)
    )  # fmt: skip
    for (a, _), (b, _) in zip(plain, more, strict=True):
        assert a.localized and np.array_equal(a.wTc, b.wTc)
        assert np.array_equal(a.observations.landmark, b.observations.landmark)


def test_a_pose_is_as_significant_by_modes(room):
    both, dark = _other_light(room)
    _, truth = room.path(1)

    def support(features: Features, modes):
        witness = Witness(features, room.camera, modes)
        index = np.arange(len(room.map.landmarks))
        return witness.support(truth[0], room.map.landmarks, index)

    seen = dark.features(truth[0])
    known = support(room.features(truth[0]), None)
    unknown, told = support(seen, None), support(seen, both.modes)
    assert unknown.significance < 6 < told.significance
    assert told.share > 0.8 * known.share and told.expected == unknown.expected
    assert len(np.unique(told.feature)) == len(told.feature)
    points = poses.transform(poses.inverse(truth[0]), room.map.landmarks.position_m[told.landmark])
    off = np.linalg.norm(room.camera.project(points) - seen.keypoints_px[told.feature], axis=1)
    assert np.median(off) < 2.0


def test_chance_finds_as_much_in_a_smaller_picture(room):
    """Features of descriptors that are all alike: what is near enough counts, and nothing else."""
    small = Scale(0.5).camera(room.camera)
    alike = np.tile(room.map.landmarks.descriptor[:1], (len(room.map.landmarks), 1))
    landmarks = replace(room.map.landmarks, descriptor=alike)
    _, truth = room.path(1)
    seen = room.features(truth[0], outliers=0.0)
    flat = room.camera.undistort(seen.keypoints_px)
    found = []
    for camera in (room.camera, small):
        features = replace(
            seen,
            keypoints_px=camera.distort(flat).astype(np.float32),
            descriptors=alike[: len(seen)],
        )
        index = np.arange(len(landmarks))
        found.append(Witness(features, camera).support(truth[0], landmarks, index))
    large, little = found
    assert little.expected == pytest.approx(large.expected, rel=0.05)
    assert large.chance > 0.02 and little.chance == pytest.approx(large.chance, rel=0.2)
