"""In a corridor of equal bays every image ends in its own one, or is left out."""

from __future__ import annotations

import dataclasses

import corridor_geometry as geometry
import numpy as np
import pytest

from ground_station.map import colmap
from ground_station.mapping.construction import structure
from ground_station.mapping.construction.pairs import sequences
from ground_station.mapping.construction.placing import chains, lookalikes, loops
from ground_station.mapping.construction.placing.placed import Placed
from ground_station.mapping.settings import MappingSettings
from ground_station.mapping.sfm.database import write_database
from ground_station.mapping.sfm.incremental import Incremental, Wanted
from ground_station.mapping.sfm.two_view import TwoView

SETTINGS = MappingSettings(threads=1)


@pytest.fixture(scope="module")
def corridor() -> geometry.Corridor:
    """Four fifths of the points are the same in every bay."""
    return geometry.make_corridor(own=30, alike=120)


@pytest.fixture(scope="module")
def plain(corridor, tmp_path_factory) -> colmap.Reconstruction:
    """What COLMAP makes of all pairs, unjudged."""
    return _plain(corridor, corridor.pairs, tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def judged(corridor, tmp_path_factory) -> structure.Structure:
    return _judged(corridor, tmp_path_factory.mktemp("judged"))


def _plain(corridor, pairs, work) -> colmap.Reconstruction:
    images, database = corridor.images, work / "database.db"
    write_database(database, corridor.camera, images.names, images.pinhole_px, pairs)
    models = Incremental(database, work, Wanted(0, 1, 1.5, len(images.names)), lambda: None).run()
    return max(models, key=lambda model: model.num_reg_images())


def _judged(corridor, work, before=()) -> structure.Structure:
    return structure.reconstruct(
        corridor.images, corridor.pairs, corridor.camera, SETTINGS, 1, work, before
    )


def _links(corridor) -> set[tuple[int, int]]:
    sequence = sequences(corridor.images.names, corridor.images.time_ns)
    ordered = chains.in_order(sequence, corridor.pairs)
    near = chains.in_front(corridor.pairs, corridor.images.pinhole_px, corridor.camera.matrix)
    return chains.links([*map(len, corridor.images.pinhole_px)], sequence, ordered, near)


def _misplaced(corridor, model) -> set[int]:
    placed = Placed.of(colmap.to_arrays(model), corridor.images.pinhole_px)
    return lookalikes.misplaced(placed, _links(corridor), corridor.pairs)


def test_plain_structure_from_motion_folds_the_corridor_and_the_judged_one_does_not(
    corridor, plain, judged
):
    assert np.count_nonzero(geometry.error_m(corridor, plain) > 1.0) > 10
    off = geometry.error_m(corridor, judged.reconstruction)
    assert off.max() < 0.02
    assert len(off) == len(corridor.images.names)
    assert judged.dropped == [] and judged.sizes == [len(off)]
    assert "stood where other images see something else" in judged.notes[0]


def test_single_images_in_a_place_that_looks_like_theirs_are_placed_anew(tmp_path):
    corridor = geometry.make_corridor(own=60, alike=90)
    found = _judged(corridor, tmp_path)
    off = geometry.error_m(corridor, found.reconstruction)
    assert off.max() < 0.02
    assert len(off) >= len(corridor.images.names) - 1


def test_links_lead_along_the_way_and_never_to_another_bay(corridor):
    links = _links(corridor)
    assert {(k, k + 1) for k in range(len(corridor.images.names) - 1)} <= links
    assert len([pair for pair in corridor.misled if pair[1] - pair[0] <= chains.REACH]) > 20
    assert not corridor.misled & links


def test_the_judge_doubts_nobody_in_a_right_model_and_many_in_the_folded_one(
    corridor, plain, judged
):
    assert _misplaced(corridor, judged.reconstruction) == set()
    wrong = _misplaced(corridor, plain)
    assert len(wrong) > 10
    placed = Placed.of(colmap.to_arrays(plain), corridor.images.pinhole_px)
    links = _links(corridor)
    lies = lookalikes.refuted(placed, wrong, links, corridor.pairs)
    assert lies and not lies & links


def test_a_model_of_the_chain_tells_the_way_back_from_the_next_bay(corridor, tmp_path):
    links = _links(corridor)
    model = _plain(corridor, loops.among(corridor.pairs, links), tmp_path)
    assert geometry.error_m(corridor, model).max() < 0.3
    placed = Placed.of(colmap.to_arrays(model), corridor.images.pinhole_px)
    sequence = np.zeros(len(corridor.images.names), dtype=np.int64)
    believed = loops.believed([placed], sequence, links, corridor.pairs)
    assert not believed & corridor.misled
    true = set(corridor.pairs) - corridor.misled
    assert len(believed) > 0.9 * len(true)
    assert len(believed - links) > 100  # among them those of the way back


def _cut_at_the_turn() -> geometry.Corridor:
    """Where the camera turned round too fast for a chain, nothing tells the next bay from this."""
    corridor = geometry.make_corridor(frames=36, own=30, alike=120)
    middle = len(corridor.images.names) // 2
    cut = {
        (i, j) for i, j in corridor.pairs if i < middle <= j and j - i <= chains.REACH
    }  # fmt: skip
    corridor.pairs = loops.among(corridor.pairs, corridor.pairs.keys() - cut)
    return corridor


def test_halves_that_only_lookalikes_join_are_not_one_model(tmp_path):
    corridor = _cut_at_the_turn()
    middle = len(corridor.images.names) // 2
    found = _judged(corridor, tmp_path)
    assert found.sizes == [middle, middle] and found.dropped == []
    for model in (found.reconstruction, *found.parts):
        assert geometry.error_m(corridor, model).max() < 0.02
    assert "form a model of their own" in " ".join(found.notes)


def test_halves_that_another_lens_has_joined_stay_one_model(tmp_path):
    corridor = _cut_at_the_turn()
    before = {k + 1: wTc for k, wTc in enumerate(corridor.wTc)}
    found = _judged(corridor, tmp_path, [before])
    assert found.sizes == [len(before)]
    assert geometry.error_m(corridor, found.reconstruction).max() < 0.02


def test_pictures_in_no_order_of_equal_bays_are_placed_or_doubted(corridor, tmp_path):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(corridor.images.names))
    at = np.argsort(order)
    pairs = {}
    for (i, j), view in corridor.pairs.items():
        a, b = int(at[i]), int(at[j])
        if a > b:
            a, b, view = b, a, TwoView(view.matches[:, ::-1], view.essential.T, None, False)
        pairs[a, b] = view
    sequence = np.zeros(len(order), dtype=np.int64)
    assert not chains.in_order(sequence, pairs).any()
    shuffled = dataclasses.replace(
        corridor,
        wTc=corridor.wTc[order],
        images=dataclasses.replace(
            corridor.images, pinhole_px=[corridor.images.pinhole_px[k] for k in order]
        ),
        pairs=pairs,
    )
    found = _judged(shuffled, tmp_path)
    right = geometry.error_m(shuffled, found.reconstruction).max() < 0.02
    assert right or found.doubts or found.notes
