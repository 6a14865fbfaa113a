"""A large build in parts: cut where little is lost, joined as they were, united to one model."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment, align
from ground_station.map import colmap
from ground_station.mapping.construction.dask_option import open_workers
from ground_station.mapping.construction.images import Images
from ground_station.mapping.construction.parts import joining, reconstruction, solving
from ground_station.mapping.construction.parts.cutting import inside, overlapping
from ground_station.mapping.construction.parts.reconstruction import reconstruct
from ground_station.mapping.construction.parts.solving import Solved
from ground_station.mapping.construction.structure import adjust_and_filter
from ground_station.mapping.construction.verification import match
from ground_station.mapping.construction.workers import Threads
from ground_station.mapping.settings import MappingSettings, SfmSettings
from ground_station.mapping.sfm.two_view import TwoView
from ground_station.simulator.campus import CAMERA, campus

SETTINGS = MappingSettings(sfm=SfmSettings(part_images=30))


def _chain(images, reach=4):
    return {
        (i, i + step): 120 // step
        for i in range(images)
        for step in range(1, reach + 1)
        if i + step < images
    }


def test_every_linked_image_is_the_core_of_one_part_and_none_is_too_large():
    pairs = _chain(500)
    parts = overlapping(pairs, 510, 100)
    cores = np.concatenate([part.core for part in parts])
    assert sorted(cores.tolist()) == list(range(500))  # the last ten share nothing with anyone
    assert all(len(part.core) <= 100 for part in parts) and len(parts) <= 10
    again = overlapping(pairs, 510, 100)
    assert all(np.array_equal(a.images, b.images) for a, b in zip(parts, again, strict=True))


def test_parts_overlap_by_the_images_beside_the_cut():
    parts = overlapping(_chain(300), 300, 100)
    for one, other in itertools.pairwise(parts):
        common = np.intersect1d(one.images, other.images)
        # Ten of a hundred from either side of the cut, and the cut is between them.
        assert len(common) == 20 and np.array_equal(common, np.arange(common[0], common[0] + 20))
        assert common[0] < one.core[-1] < common[-1]
        assert np.array_equal(np.setdiff1d(one.images, one.core)[-10:], other.core[:10])


def test_a_cut_goes_where_few_matches_are():
    pairs = {pair: 100 for pair in _chain(80) if (pair[0] < 37) == (pair[1] < 37)}
    pairs |= {(36, 37): 30, (35, 38): 30, (36, 39): 30}
    cores = [part.core.tolist() for part in overlapping(pairs, 80, 60)]
    assert cores == [list(range(37)), list(range(37, 80))]


def test_a_part_gets_the_pairs_of_images_that_it_has_both_of():
    pairs = _chain(300)
    parts = overlapping(pairs, 300, 100)
    for part, mine in zip(parts, inside(parts, pairs, 300), strict=True):
        members = set(part.images.tolist())
        assert mine == [(i, j) for i, j in pairs if i in members and j in members]


def test_what_shares_nothing_is_not_put_into_one_part():
    pairs = _chain(40) | {(i + 50, j + 50): n for (i, j), n in _chain(30).items()}
    parts = overlapping(pairs, 80, 60)
    assert [part.images.tolist() for part in parts] == [list(range(40)), list(range(50, 80))]


RNG = np.random.default_rng(8)


def _scene(images=60, seen=80):
    """Images along x that look at a wall of points: poses, points, which each image sees."""
    points = RNG.uniform([-2, -1.5, 3], [images * 0.2 + 2, 1.5, 6], (60 * images, 3))
    wTc = np.tile(np.eye(4), (images, 1, 1))
    wTc[:, 0, 3] = 0.2 * np.arange(images)
    sees = [np.argsort(np.abs(points[:, 0] - x), kind="stable")[:seen] for x in wTc[:, 0, 3]]
    return wTc, points, sees


def _solved(scene, index, by):
    """A part of the scene in coordinates of its own: those that `by` takes to the scene's."""
    wTc, points, sees = scene
    index = np.asarray(index)
    shown = np.unique(np.concatenate([sees[k] for k in index]))
    inverse = joining._inverse(by)
    return Solved(
        index,
        inverse.apply_poses(wTc[index]),
        inverse.apply(points[shown]),
        np.repeat(np.arange(len(index)), len(sees[0])),
        np.tile(np.arange(len(sees[0])), len(index)),
        np.concatenate([np.searchsorted(shown, sees[k]) for k in index]),
        np.array([120.0, 120.0, 119.5, 89.5]),
        np.array([], dtype=np.str_),
    )


def _similarity(turn, move, scale):
    return Alignment(Rotation.from_rotvec(turn).as_matrix(), np.array(move, float), scale)


PLACES = [
    _similarity([0.0, 0.0, 0.0], [0, 0, 0], 1.0),
    _similarity([0.3, -0.8, 0.1], [5, -2, 1], 0.3),
    _similarity([-1.2, 0.4, 2.0], [-40, 3, 9], 7.0),
]


def test_parts_find_their_places_whatever_their_own_coordinates():
    scene = _scene()
    runs = [range(30), range(20, 50), range(40, 60)]
    parts = [_solved(scene, run, by) for run, by in zip(runs, PLACES, strict=True)]
    similarities, notes = joining.join(parts, 0)
    assert notes == []
    for part, at in zip(parts, similarities, strict=True):
        assert np.allclose(at.apply_poses(part.wTc), scene[0][part.index], atol=1e-6)


def test_a_junction_that_all_others_contradict_is_left_out_and_said():
    scene = _scene()
    runs = [range(30), range(20, 50), range(40, 60)]
    parts = [_solved(scene, run, by) for run, by in zip(runs, PLACES, strict=True)]
    # The last part claims to see the first one's images 5 to 9 where it stands: a fold.
    other = _solved(scene, range(5, 10), PLACES[2])
    last = parts[2]
    fold = dataclasses.replace(
        last,
        index=np.concatenate([other.index, last.index]),
        wTc=np.concatenate([other.wTc, last.wTc]),
        position=np.concatenate([last.position, other.position + np.array([3.0, 0.0, 0.0])]),
        image=np.concatenate([other.image, last.image + 5]),
        feature=np.concatenate([other.feature, last.feature]),
        point=np.concatenate([other.point + len(last.position), last.point]),
    )
    similarities, notes = joining.join([*parts[:2], fold], 0)
    assert "parts 0 and 2 over 5 images: other parts contradict it" in " ".join(notes)
    moved = similarities[2].apply_poses(last.wTc)
    assert np.allclose(moved, scene[0][last.index], atol=1e-3)


def test_parts_with_nothing_in_common_stay_apart_and_are_counted():
    scene = _scene()
    parts = [_solved(scene, range(30), PLACES[0]), _solved(scene, range(40, 60), PLACES[1])]
    similarities, notes = joining.join(parts, 0)
    assert similarities[1] is None
    assert notes == ["20 images are in parts that join no other"]


def _united(scene, runs, pairs):
    wTc, points, sees = scene
    parts = [_solved(scene, run, PLACES[0]) for run in runs]
    pixels = []
    for T, seen in zip(wTc, sees, strict=True):
        local = points[seen] - T[:3, 3]
        pixels.append(local[:, :2] / local[:, 2:] * 120.0 + [119.5, 89.5])
    names = [str(k) for k in range(len(wTc))]
    images = Images(names, np.arange(len(wTc)), [], pixels)
    cores = [np.array(run) for run in runs]
    return reconstruction.unite(parts, cores, PLACES[:1] * len(runs), images, pairs, CAMERA)


def test_a_landmark_of_two_parts_is_one_with_all_its_observations():
    scene = _scene()
    model = _united(scene, [range(30), range(20, 60)], {})
    _, observations = np.unique(np.concatenate(scene[2]), return_counts=True)
    assert len(model.names) == 60
    assert sorted(np.bincount(model.point)) == sorted(observations[observations > 1])


def test_a_pair_of_images_that_no_part_has_both_of_unites_what_stands_where_it_says():
    scene = _scene()
    runs = [range(30), range(30, 60)]  # nothing in common
    _, first, second = np.intersect1d(scene[2][29], scene[2][30], return_indices=True)
    view = TwoView(np.stack([first, second], axis=1), np.eye(3), None, False)
    # Matches that lead elsewhere unite nothing.
    wrong = dataclasses.replace(view, matches=np.stack([first, np.roll(second, 7)], axis=1))

    def seen_by_both(pairs):
        model = _united(scene, runs, pairs)
        return len(np.intersect1d(*(model.point[model.image == k] for k in (29, 30))))

    assert len(first) > 20
    assert seen_by_both({}) == seen_by_both({(29, 30): wrong}) == 0
    assert seen_by_both({(29, 30): view}) == len(first)


IMAGES = 70


@pytest.fixture(scope="module")
def hall():
    """A simulated campus of 70 images: images, pairs, true poses."""
    made = campus(IMAGES, 2)
    features = list(made.features())
    names = [f"{k:03d}" for k in range(IMAGES)]
    pixels = [CAMERA.undistort_to_pinhole(each.keypoints_px) for each in features]
    images = Images(names, made.time_ns, features, pixels)
    return images, match(images, CAMERA, SETTINGS, Threads(2)), made.wTc


def _error_m(model, wTc):
    centres, truth = model.wTc[:, :3, 3], wTc[model.image_id - 1, :3, 3]
    return np.linalg.norm(align(centres, truth, True).apply(centres) - truth, axis=1)


def test_in_parts_a_campus_is_whole_and_as_true_as_in_one(hall, tmp_path, monkeypatch):
    images, pairs, wTc = hall
    made = reconstruct(images, pairs, CAMERA, SETTINGS, 2, tmp_path / "parts", Threads(2))
    assert made.sizes == [IMAGES] and "in 4 parts, 4 of them joined" in made.notes[0]
    in_parts = adjust_and_filter(made.reconstruction, SETTINGS.sfm, 2)
    one = dataclasses.replace(SETTINGS, sfm=SfmSettings(part_images=IMAGES))
    (tmp_path / "one").mkdir()
    whole = reconstruct(images, pairs, CAMERA, one, 2, tmp_path / "one", Threads(2))
    assert not whole.notes
    error, before = (
        _error_m(model, wTc)
        for model in (in_parts, adjust_and_filter(whole.reconstruction, one.sfm, 2))
    )
    assert np.sqrt(np.mean(error**2)) <= 1.5 * np.sqrt(np.mean(before**2)) and error.max() < 0.2
    # The features are those of the images: a landmark's descriptor comes from there.
    for o in range(0, len(in_parts.point), 997):
        k = in_parts.image_id[in_parts.image[o]] - 1
        assert np.allclose(images.pinhole_px[k][in_parts.feature[o]], in_parts.pixel_px[o])
    # A build that was killed now does not make its parts again.
    monkeypatch.setattr(solving, "_solved", lambda *_: pytest.fail("made again"))
    again = reconstruct(images, pairs, CAMERA, SETTINGS, 2, tmp_path / "parts", Threads(2))
    assert again.sizes == [IMAGES]
    monkeypatch.undo()
    (tmp_path / "parts/parts/0001.npz").write_bytes(b"half")
    repaired = reconstruct(images, pairs, CAMERA, SETTINGS, 2, tmp_path / "parts", Threads(2))
    one, other = (colmap.to_arrays(each.reconstruction) for each in (again, repaired))
    assert np.array_equal(one.point, other.point) and np.array_equal(one.image, other.image)


def test_workers_that_read_no_files_of_ours_make_the_same_parts(hall, tmp_path):
    few = {pair: view for pair, view in hall[1].items() if max(pair) < 34}
    first = solving.given(np.arange(34), hall[0], few)
    images, pairs = first.images, first.pairs
    expected = reconstruct(images, pairs, CAMERA, SETTINGS, 1, tmp_path / "a", Threads(1))
    with open_workers("1", 1, SETTINGS) as workers:
        workers.here = False
        found = reconstruct(images, pairs, CAMERA, SETTINGS, 1, tmp_path / "b", workers)
    assert list(tmp_path.glob("a/parts/*.npz")) and not list(tmp_path.glob("b/parts/*.npz"))
    one, other = (colmap.to_arrays(each.reconstruction) for each in (expected, found))
    for name in ("wTc", "position", "image", "feature", "point"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_pictures_that_give_no_model_are_one_line(hall, tmp_path):
    images, pairs, _ = hall
    turned = {
        pair: dataclasses.replace(view, degenerate=True, matches=view.matches[:20])
        for pair, view in list(pairs.items())[::9]
    }
    with pytest.raises(MapError, match=r"no model in any of \d+ parts: the camera must") as caught:
        reconstruct(images, turned, CAMERA, SETTINGS, 1, tmp_path, Threads(1))
    assert "\n" not in str(caught.value)
