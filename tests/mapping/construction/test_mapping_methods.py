"""Every method of structure from motion gives the map, and what is finished is not done again."""

from __future__ import annotations

import dataclasses

import corridor_geometry as geometry
import numpy as np
import pycolmap
import pytest

from ground_station.map import colmap
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.placing import contradictions
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm import global_mapping
from ground_station.mapping.sfm.incremental import Incremental
from ground_station.mapping.sfm.two_view import TwoView

SHIPPED = MappingSettings()


def _settings(method: str) -> MappingSettings:
    return dataclasses.replace(SHIPPED, sfm=dataclasses.replace(SHIPPED.sfm, method=method))


@pytest.fixture(scope="module")
def corridor() -> geometry.Corridor:
    return geometry.make_corridor(frames=30, bays=3, own=110, alike=0)


def _reconstruct(corridor, method, work) -> structure.Structure:
    return structure.reconstruct(
        corridor.images, corridor.pairs, corridor.camera, _settings(method), 1, work
    )


@pytest.mark.parametrize("method", ["incremental", "global", "auto"])
def test_each_method_places_every_image_and_does_it_once(corridor, method, tmp_path, monkeypatch):
    found = _reconstruct(corridor, method, tmp_path)
    off = geometry.error_m(corridor, found.reconstruction)
    assert len(off) == 30 and off.max() < 0.03
    before = colmap.to_arrays(found.reconstruction).wTc

    def never(*_, **__):
        raise AssertionError("what was finished ran again")

    monkeypatch.setattr(colmap.pycolmap, "global_mapping", never)
    monkeypatch.setattr(Incremental, "_batch", never)
    again = _reconstruct(corridor, method, tmp_path)
    assert np.abs(colmap.to_arrays(again.reconstruction).wTc - before).max() < 1e-9


def test_auto_falls_back_where_the_global_method_leaves_images_out(corridor, tmp_path, monkeypatch):
    monkeypatch.setattr(global_mapping, "reconstruct", lambda *_: [])
    assert _reconstruct(corridor, "auto", tmp_path / "auto").sizes == [30]
    with pytest.raises(structure.MapError, match="found no pair of images to start from"):
        _reconstruct(
            dataclasses.replace(corridor, pairs=dict(list(corridor.pairs.items())[:1])),
            "auto",
            tmp_path / "nothing",
        )


@pytest.mark.parametrize("turn_deg", [0.0, 3.0])
def test_a_camera_that_stays_in_its_place_is_refused_before_colmap_tries(
    corridor, tmp_path, monkeypatch, turn_deg
):
    rng = np.random.default_rng(0)
    matrix = corridor.camera.matrix
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (300, 2)), np.ones(300)])
    pictures = []
    for turn in np.radians(turn_deg) * np.arange(5):
        c, s = np.cos(turn), np.sin(turn)
        seen = rays @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ matrix.T
        pictures.append(seen[:, :2] / seen[:, 2:] + rng.normal(0, 0.4, (300, 2)))
    same = np.repeat(np.arange(300, dtype=np.int32)[:, None], 2, axis=1)
    view = TwoView(same, np.eye(3), None, degenerate=True)
    pairs = {(i, j): view for i in range(5) for j in range(i + 1, 5)}
    images = dataclasses.replace(
        corridor.images,
        names=corridor.images.names[:5],
        time_ns=corridor.images.time_ns[:5],
        pinhole_px=pictures,
    )

    def never(*_, **__):
        raise AssertionError("COLMAP tried")

    monkeypatch.setattr(Incremental, "run", never)
    with pytest.raises(structure.MapError, match="the camera must move sideways"):
        structure.reconstruct(images, pairs, corridor.camera, SHIPPED, 1, tmp_path)


def test_a_bent_end_is_taken_from_the_method_that_starts_nowhere(corridor, tmp_path, monkeypatch):
    run = Incremental.run

    def bent(self, start=None):
        models = run(self, start)
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.3, 0.0])), np.zeros(3))
        for image_id in range(21, 31):
            frame = models[0].frame(models[0].image(image_id).frame_id)
            frame.rig_from_world = turn * frame.rig_from_world
        return models

    monkeypatch.setattr(Incremental, "run", bent)
    found = _reconstruct(corridor, "incremental", tmp_path)
    off = geometry.error_m(corridor, found.reconstruction)
    assert len(off) == 30 and off.max() < 0.03
    assert found.doubts == [] and found.parts == []


def test_what_pairs_contradict_is_placed_again_from_what_is_right(corridor, tmp_path, monkeypatch):
    groups, asked = contradictions.consistent_groups, []

    def broken_once(placed, *rest):
        asked.append(sorted(placed.wTc))
        return [{*range(20)}, {*range(20, 30)}] if len(asked) == 1 else groups(placed, *rest)

    monkeypatch.setattr(contradictions, "consistent_groups", broken_once)
    monkeypatch.setattr(global_mapping, "reconstruct", lambda *_: pytest.fail("asked in vain"))
    found = _reconstruct(corridor, "incremental", tmp_path)
    off = geometry.error_m(corridor, found.reconstruction)
    assert len(off) == 30 and off.max() < 0.03
    assert found.doubts == [] and found.parts == []
    assert asked[0] == asked[-1] == [*range(30)]
