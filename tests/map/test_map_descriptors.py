"""Descriptors stay in their file, a byte a number, and come out as unit rows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hand_made import NO_KEYFRAMES
from safetensors import safe_open
from safetensors.numpy import save_file

from ground_station.errors import MapError
from ground_station.geometry.alignment import Alignment
from ground_station.map import store
from ground_station.map.descriptors import Descriptors, open_descriptors, quantised
from ground_station.map.levelling import transformed


@pytest.fixture
def rows():
    rows = np.random.default_rng(3).normal(size=(50, 16)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize("name", ["descriptor_u8", "descriptor_i8"])
def test_rows_are_unit_float32_within_a_degree_of_what_was_quantised(rows, name, tmp_path):
    rows = np.abs(rows) if name == "descriptor_u8" else rows
    arrays = quantised(rows)
    assert list(arrays) == [name] and arrays[name].itemsize == 1
    save_file(arrays, tmp_path / "rows")
    kept = open_descriptors(tmp_path / "rows", *rows.shape)
    assert kept.shape == (50, 16) and len(kept) == 50
    index = np.array([4, 4, 49, 0])
    for some in (index, slice(10, 20), rows[:, 0] > 0.2):
        assert kept[some].dtype == np.float32
        assert np.allclose(np.linalg.norm(kept[some], axis=1), 1, atol=1e-6)
        cosine = np.einsum("ij,ij->i", kept[some], rows[some])
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1
    assert np.array_equal(kept[7], kept[7:8][0])
    assert np.array_equal(np.asarray(kept), kept[:]) and np.asarray(kept, float).dtype == float
    assert kept[np.empty(0, int)].shape == (0, 16)
    assert np.array_equal(quantised(kept)[name], arrays[name])


def test_a_row_of_nothing_is_nothing_and_not_nan():
    assert not Descriptors(np.zeros((2, 8), np.uint8))[:].any()


def test_rows_that_were_not_quantised_are_made_unit(rows):
    kept = Descriptors(3 * rows)
    assert np.allclose(kept[:], rows, atol=1e-6)
    again = Descriptors(quantised(kept)["descriptor_i8"])
    assert np.abs(again[:] - rows).max() < 0.01


def test_a_loaded_map_keeps_its_descriptors_in_the_file(built):
    kept = store.load(built.folder).landmarks.descriptor
    assert isinstance(kept, Descriptors)
    assert isinstance(kept.values.base, np.memmap) or isinstance(kept.values, np.memmap)
    assert kept.values.dtype == np.uint8 and not kept.values.flags.writeable


def test_a_map_is_replaced_while_another_still_reads_it(target):
    loaded = store.load(target)
    before = loaded.landmarks.descriptor[:].copy()
    store.save_tables(target, loaded)
    assert np.array_equal(loaded.landmarks.descriptor[:], before)
    assert np.array_equal(store.load(target).landmarks.descriptor[:], before)


def test_a_map_says_how_it_bends_or_nothing(built, tmp_path):
    plain = store.load(built.folder)
    landmarks = plain.landmarks
    count = len(landmarks)
    follows = np.random.default_rng(1).normal(size=(count, 3)).astype(np.float32)
    bent = dataclasses.replace(plain, landmarks=dataclasses.replace(landmarks, by_focal_m=follows))
    store.save_tables(tmp_path, bent)
    assert np.array_equal(store.load(tmp_path).landmarks.by_focal_m, follows)
    turned = Alignment(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.ones(3), 2.0)
    moved = transformed(bent, turned).landmarks.by_focal_m
    assert np.allclose(moved, 2 * np.c_[-follows[:, 1], follows[:, 0], follows[:, 2]])
    none = dataclasses.replace(landmarks, by_focal_m=np.zeros((count, 3), np.float32))
    store.save_tables(tmp_path, dataclasses.replace(plain, landmarks=none))
    assert not store.load(tmp_path).landmarks.by_focal_m.any()
    with safe_open(tmp_path / "landmarks.safetensors", framework="numpy") as file:
        assert "by_focal_m" not in file.keys()  # noqa: SIM118
    wrong = dataclasses.replace(landmarks, by_focal_m=follows[: count - 1])
    store.save_tables(tmp_path, dataclasses.replace(plain, landmarks=wrong))
    with pytest.raises(MapError, match="differ in length"):
        store.load(tmp_path)


def test_a_map_without_landmarks_has_no_descriptors(built, tmp_path):
    fields = [field.name for field in dataclasses.fields(store.Landmarks)]
    none = store.Landmarks(**{n: getattr(built.map.landmarks, n)[:0] for n in fields})
    store.save_tables(tmp_path, store.Map(built.map.info, none, NO_KEYFRAMES))
    loaded = store.load(tmp_path).landmarks
    assert len(loaded) == 0 and loaded.descriptor[:].shape == (0, built.map.info.dimension)
