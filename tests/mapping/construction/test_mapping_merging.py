"""Models that split are joined where landmarks say how, and only where they say one way."""

from __future__ import annotations

from dataclasses import replace

import corridor_geometry as geometry
import numpy as np
import pytest
from hand_made import model_of
from scipy.spatial.transform import Rotation

from ground_station.geometry.alignment import Alignment
from ground_station.map import colmap, landmarks
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.placing import loops, merging
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.construction.solver import Solver
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.two_view import TwoView

PINHOLE = np.array([500.0, 500.0, 320.0, 240.0])
LANDMARKS = 120
MOTION = Alignment(
    Rotation.from_rotvec([0.2, -0.4, 1.1]).as_matrix(), np.array([3.0, -1.0, 0.5]), 2.5
)


def _two_models(shift=None, noise=0.0):
    """Two models of one place: image 0 in the first, image 1 in the second, matched one to one.

    A share of the second's landmarks is moved by `shift` (its number, a vector).
    """
    rng = np.random.default_rng(3)
    source = rng.uniform([-2, -1, 3], [2, 1, 6], (LANDMARKS, 3))
    target = MOTION.apply(source) + noise * rng.normal(size=source.shape)
    if shift is not None:
        target[: shift[0]] += shift[1]
    every = np.arange(LANDMARKS)
    nothing = np.full(LANDMARKS, -1)
    wTc = np.eye(4)
    moved = MOTION.apply_poses(wTc[None])[0]
    first = Placed([every, nothing], {0: moved}, target, PINHOLE)
    second = Placed([nothing, every], {1: wTc}, source, PINHOLE)
    matches = np.stack([every, every], axis=1).astype(np.int32)
    return first, second, {(0, 1): TwoView(matches, np.eye(3), None, False)}


def test_landmarks_of_a_pair_between_two_models_give_the_similarity():
    target, source, pairs = _two_models(shift=(30, [9.0, 0.0, 4.0]), noise=0.02)
    found = merging.junction(target, source, pairs, seed=0).similarity
    assert found is not None
    assert found.scale == pytest.approx(MOTION.scale, rel=0.01)
    poses = merging.poses_in(source, found, set(target.wTc))
    assert list(poses) == [2]  # COLMAP's id
    assert np.abs(poses[2] - MOTION.apply_poses(np.eye(4)[None])[0]).max() < 0.05


def test_two_places_that_fit_nearly_as_well_are_none():
    target, source, pairs = _two_models(shift=(50, [8.0, 0.0, 0.0]))
    junction = merging.junction(target, source, pairs, seed=0)
    assert junction.similarity is None
    assert junction.missing == (
        "they fit the largest in two places: 70 landmarks say one, 50 another"
    )


def test_what_is_missing_between_models_is_said():
    target, source, pairs = _two_models()
    assert merging.junction(target, source, {}, 0).missing == "no pair links them to the largest"
    few = {(0, 1): TwoView(pairs[0, 1].matches[:20], np.eye(3), None, False)}
    junction = merging.junction(target, source, few, 0)
    assert junction.similarity is None
    assert junction.missing == (
        "1 pairs or images link them to the largest, but 0 of 20 landmarks in common fit together, "
        "30 must"
    )


@pytest.fixture(scope="module")
def corridor() -> geometry.Corridor:
    return geometry.make_corridor(frames=40, bays=3, own=110, alike=0)


def _solver(corridor, work) -> Solver:
    return Solver(
        corridor.images, corridor.pairs, corridor.camera, MappingSettings(), threads=1, work=work
    )


def _halves(corridor) -> set[tuple[int, int]]:
    """The pairs within the first half of the images and within the second."""
    middle = len(corridor.images.names) // 2
    return {pair for pair in corridor.pairs if (pair[0] < middle) == (pair[1] < middle)}


def test_models_that_split_become_one_by_the_pairs_between_them(corridor, tmp_path):
    apart = loops.among(corridor.pairs, _halves(corridor))
    run = _solver(corridor, tmp_path)
    models, notes = run.solve("apart", apart, joining=corridor.pairs)
    assert notes == ["a model of 20 images joined to one of 20"]
    assert [model.num_reg_images() for model in models] == [40]
    assert geometry.error_m(corridor, models[0]).max() < 0.03
    found = structure.adjust_and_filter(models[0], MappingSettings().sfm, 1)
    assert found.names == corridor.images.names
    assert np.bincount(found.point).min() >= MappingSettings().sfm.min_track


def test_poses_of_another_lens_are_where_the_search_begins(corridor, tmp_path):
    """A longer lens's model has the same images a little further apart along their way."""
    run = _solver(corridor, tmp_path)
    longer = corridor.wTc.copy()
    longer[:, 1, 3] *= 1.02
    places = dict(enumerate(longer, start=1))
    first = {k: wTc for k, wTc in places.items() if k <= 30}
    (model,), notes = run.solve("before", corridor.pairs, starts=[first])
    assert model.num_reg_images() == 40 and notes == []
    assert geometry.error_m(corridor, model).max() < 0.03
    found = structure.reconstruct(
        corridor.images, corridor.pairs, corridor.camera, MappingSettings(), 1, tmp_path / "whole",
        [places],
    )  # fmt: skip
    assert geometry.error_m(corridor, found.reconstruction).max() < 0.03


def test_models_that_stayed_apart_by_another_lens_begin_each_where_it_was(corridor, tmp_path):
    apart = loops.among(corridor.pairs, _halves(corridor))
    half = [
        {k + 1: corridor.wTc[k] for k in members} for members in (range(20), range(20, 40))
    ]  # fmt: skip
    found = structure.reconstruct(
        corridor.images, apart, corridor.camera, MappingSettings(), 1, tmp_path, half
    )
    assert found.sizes == [20, 20]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["before"]
    for model in (found.reconstruction, *found.parts):
        assert geometry.error_m(corridor, model).max() < 0.03


def test_an_image_that_stands_aside_goes_where_the_others_see_it(corridor, tmp_path):
    run = _solver(corridor, tmp_path)
    right = run.solve("all", corridor.pairs)[0][0]
    assert run.resected(right, corridor.pairs) == (right, 0)
    aside = colmap.copied(right)
    seen = colmap.to_arrays(aside)
    mine = seen.image_id[seen.image] == 21
    colmap.drop_observations(aside, seen.image_id[seen.image[mine]], seen.feature[mine])
    frame = aside.frame(aside.image(21).frame_id)
    wrong = np.array(frame.rig_from_world.matrix())
    wrong[:, 3] += 0.2 * run.placed(right).depth
    frame.rig_from_world = colmap.pycolmap.Rigid3d(wrong)
    found, moved = run.resected(aside, corridor.pairs)
    assert moved == 1 and found.num_reg_images() == 40
    assert geometry.error_m(corridor, found).max() < 0.03 < geometry.error_m(corridor, aside).max()


@pytest.mark.parametrize(("kept", "stands"), [(8, False), (40, True)])
def test_an_image_of_which_little_is_left_goes(corridor, tmp_path, kept, stands):
    model = _solver(corridor, tmp_path).solve("all", corridor.pairs)[0][0]
    seen = colmap.to_arrays(model)
    mine = np.flatnonzero(seen.image_id[seen.image] == 21)[kept:]
    colmap.drop_observations(model, seen.image_id[seen.image[mine]], seen.feature[mine])
    found = structure.adjust_and_filter(model, MappingSettings().sfm, 1)
    names = corridor.images.names
    assert found.names == (names if stands else names[:20] + names[21:])
    assert np.bincount(found.image).min() >= 15


def test_what_is_left_without_misfits_is_the_model_itself(corridor, tmp_path):
    model = _solver(corridor, tmp_path).solve("all", corridor.pairs)[0][0]
    before = colmap.to_arrays(model)
    error = np.linalg.norm(landmarks.residuals_px(before), axis=1)
    strict = replace(MappingSettings().sfm, max_error_px=float(np.median(error)), min_track=4)
    left, there = structure.drop_misfits(model, strict), colmap.to_arrays(model)
    for name in ("point_id", "position", "image_id", "wTc", "image", "feature", "point"):
        assert np.array_equal(getattr(left, name), getattr(there, name)), name
    assert np.array_equal(left.pixel_px, there.pixel_px) and left.names == there.names
    assert np.linalg.norm(landmarks.residuals_px(left), axis=1).max() <= strict.max_error_px
    assert np.bincount(left.point).min() >= 4
    assert 0 < len(left.point) <= len(error) / 2 and 0 < len(left.point_id) < len(before.point_id)


def test_models_without_a_pair_between_them_are_reported_by_name(corridor, tmp_path):
    apart = loops.among(corridor.pairs, _halves(corridor))
    found = structure.reconstruct(
        corridor.images, apart, corridor.camera, MappingSettings(), 1, tmp_path
    )
    assert sorted(found.sizes) == [20, 20]
    assert found.notes in (
        [f"{a} to {b}: 20 images form a model of their own: no pair links them to the largest"]
        for a, b in (("frame-000000", "frame-000019"), ("frame-000020", "frame-000039"))
    )
    assert found.dropped == []


def test_ranges_of_names_are_few(corridor, tmp_path):
    names = [f"{k}.png" for k in range(12)]
    none = np.empty(0, np.int64)
    model = model_of(
        corridor.camera, np.tile(np.eye(4), (6, 1, 1)), np.empty((0, 3)), names=names[::2],
        image_id=np.arange(1, 13, 2), image=none, point=none, pixel_px=np.empty((0, 2)),
    )  # fmt: skip
    model = colmap.from_arrays(model, corridor.camera)
    assert merging.describe(model, names, "why").startswith(
        "0.png, 2.png, 4.png, 6.png, 2 more: 6 images form a model of their own: why"
    )
