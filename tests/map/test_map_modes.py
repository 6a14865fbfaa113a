"""Descriptor modes survive the disk, older readers do not need them, damaged ones are refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from ground_station.errors import MapError
from ground_station.map import store
from ground_station.map.descriptors import Descriptors, joined, quantised
from ground_station.map.modes import MOST, Modes, described, with_modes


def _rows(count, dimension=32, signed=False, seed=0):
    rows = np.random.default_rng(seed).normal(size=(count, dimension))
    rows = rows if signed else np.abs(rows)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def _with(built, modes, quantise=True):
    info = dataclasses.replace(built.map.info, built={"settings": {"quantise": quantise}})
    return dataclasses.replace(built.map, info=info, modes=modes)


@pytest.mark.parametrize("quantise", [True, False])
def test_modes_come_back_as_they_were_written(built, tmp_path, quantise):
    modes = Modes(np.array([3, 3, 8, 40], np.int32), _rows(4))
    store.save_tables(tmp_path, _with(built, modes, quantise))
    again = store.load(tmp_path).modes
    assert np.array_equal(again.landmark, modes.landmark) and again.landmark.dtype == np.int32
    assert np.allclose(again.descriptor[:], modes.descriptor, atol=4e-3 if quantise else 1e-6)
    assert again.descriptor.values.itemsize == (1 if quantise else 4) or not quantise
    # Written again, nothing is lost.
    store.save_tables(tmp_path / ".", store.load(tmp_path))
    assert np.array_equal(store.load(tmp_path).modes.descriptor[:], again.descriptor[:])


def test_a_map_without_modes_is_written_as_before(built, tmp_path):
    store.save_tables(tmp_path, built.map)
    arrays = load_file(tmp_path / "landmarks.safetensors")
    assert not [name for name in arrays if name.startswith("mode")]
    assert store.load(tmp_path).modes is None
    assert "extended" not in (tmp_path / "map.toml").read_text()
    with_none = _with(built, Modes(np.empty(0, np.int32), _rows(0)))
    store.save_tables(tmp_path, with_none)
    assert store.load(tmp_path).modes is None


def test_who_does_not_know_modes_reads_the_same_map(built, tmp_path):
    """Without their arrays the file is what it was: they are beside the others, not among them."""
    plain, both = tmp_path / "plain", tmp_path / "both"
    for folder, modes in ((plain, None), (both, Modes(np.array([1, 2], np.int32), _rows(2)))):
        folder.mkdir()
        store.save_tables(folder, _with(built, modes))
    before, after = (load_file(folder / "landmarks.safetensors") for folder in (plain, both))
    for name, array in before.items():
        assert np.array_equal(after[name], array)
    assert set(after) - set(before) == {"mode_landmark", "mode_descriptor_u8"}


def _set(name, value):
    def edit(arrays):
        arrays[name] = value(arrays[name])

    return edit


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_set("mode_landmark", lambda a: a[::-1].copy()), "in order"),
        (_set("mode_landmark", lambda a: a + 10**6), "in order"),
        (_set("mode_landmark", lambda a: a - 10), "in order"),
        (_set("mode_landmark", lambda a: a.astype(np.int64)), "must be int32"),
        (_set("mode_landmark", lambda a: a[:-1]), "descriptors are"),
        (_set("mode_landmark", lambda a: np.full(len(a), 5, np.int32)), f"more than {MOST}"),
        (_set("mode_descriptor_u8", lambda a: a[:, :5]), "descriptors are"),
        (_set("mode_descriptor_u8", lambda a: a.astype(np.int8)), "'mode_descriptor_u8' must be"),
        (lambda arrays: arrays.pop("mode_descriptor_u8"), "holds no mode_descriptors"),
    ],
)
def test_damaged_modes_are_refused_in_one_line(built, tmp_path, damage, words):
    of = np.arange(MOST + 2, dtype=np.int32)
    store.save_tables(tmp_path, _with(built, Modes(of, _rows(len(of)))))
    path = tmp_path / "landmarks.safetensors"
    arrays = load_file(path)
    damage(arrays)
    save_file(arrays, path, {"format": "1"})
    with pytest.raises(MapError, match=words) as caught:
        store.load(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_mode_that_is_not_a_number_is_refused(built, tmp_path):
    rows = _rows(2)
    rows[1, 3] = np.nan
    modes = Modes(np.array([1, 2], np.int32), rows)
    store.save_tables(tmp_path, _with(built, modes, quantise=False))
    with pytest.raises(MapError, match="'mode_descriptor' holds a value that is not finite"):
        store.load(tmp_path)


def test_modes_are_found_by_their_landmarks():
    modes = Modes(np.array([2, 5, 5, 9], np.int32), _rows(4))
    rows, place = modes.of(np.array([5, 0, 9, 2, 5]))
    assert rows.tolist() == [1, 2, 3, 0, 1, 2] and place.tolist() == [0, 0, 2, 3, 4, 4]
    known = _rows(10, seed=1)
    every, mode = described(known, modes, np.array([0, 5]))
    assert np.array_equal(every, np.concatenate([known[[0, 5]], modes.descriptor[1:3]]))
    assert mode.tolist() == [1, 1]
    assert described(known, modes, np.array([0, 1]))[1] is None
    assert described(known, None, np.array([5]))[1] is None


def test_modes_follow_their_landmarks_when_some_go():
    modes = Modes(np.array([2, 5, 5, 9], np.int32), _rows(4))
    kept = np.ones(10, bool)
    kept[[0, 2]] = False
    left = modes.among(kept)
    assert left.landmark.tolist() == [3, 3, 7]
    assert np.array_equal(left.descriptor, modes.descriptor[1:])
    assert modes.among(np.zeros(10, bool)) is None


@pytest.mark.parametrize("signed", [True, False])
def test_bytes_stay_as_they_are_when_rows_are_added(signed):
    kept = Descriptors(next(iter(quantised(_rows(5, signed=signed)).values())))
    more = _rows(3, signed=signed, seed=2)
    both = joined(kept, more)
    assert isinstance(both, Descriptors) and np.array_equal(both.values[:5], kept.values)
    assert np.allclose(both[5:], more, atol=0.02)
    assert joined(kept, more[:0]) is kept
    modes = with_modes(Modes(np.array([1, 4, 4, 6, 7], np.int32), kept), np.array([4, 0, 9]), more)
    assert modes.landmark.tolist() == [0, 1, 4, 4, 4, 6, 7, 9]
    assert np.array_equal(modes.descriptor.values[[1, 2, 3, 5, 6]], kept.values)
    assert np.allclose(modes.descriptor[4], more[0], atol=0.02)
