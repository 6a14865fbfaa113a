"""Descriptors as codes: taken like any others, kept in the map's file, and damaged ones refused."""

from __future__ import annotations

import numpy as np
import pytest
from safetensors.numpy import save_file

from ground_station.errors import MapError
from ground_station.map.descriptors import (
    CODEBOOK,
    CODES,
    CodedDescriptors,
    Descriptors,
    open_descriptors,
    quantised,
)

M, STRETCHES, NUMBERS, WORDS = 30, 4, 3, 5


@pytest.fixture
def coded() -> CodedDescriptors:
    rng = np.random.default_rng(4)
    book = rng.normal(size=(STRETCHES, WORDS, NUMBERS)).astype(np.float16)
    return CodedDescriptors(rng.integers(0, WORDS, (M, STRETCHES)).astype(np.uint8), book)


def test_rows_are_their_words_side_by_side_at_length_one(coded):
    assert coded.shape == (M, STRETCHES * NUMBERS) and len(coded) == M
    for m in (0, 7, M - 1):
        words = [coded.codebook[s, coded.codes[m, s]] for s in range(STRETCHES)]
        row = np.concatenate(words).astype(np.float32)
        assert np.allclose(coded[m], row / np.linalg.norm(row), atol=1e-6)
    index = np.array([4, 4, 29, 0])
    mask = np.arange(M) % 3 == 0
    for some in (index, slice(10, 20), mask):
        assert np.array_equal(coded[some], coded[:][some]) and coded[some].dtype == np.float32
    assert np.array_equal(np.asarray(coded), coded[:])
    assert coded[np.empty(0, int)].shape == (0, STRETCHES * NUMBERS)
    assert np.array_equal(coded.rows(index)[:], coded[index])


@pytest.mark.parametrize("signed", [True, False])
def test_values_are_the_same_rows_with_a_byte_a_number(coded, signed):
    if not signed:
        coded = CodedDescriptors(coded.codes, np.abs(coded.codebook))
    assert coded.values.dtype == (np.int8 if signed else np.uint8)
    assert np.abs(Descriptors(coded.values)[:] - coded[:]).max() < 0.02


def test_codes_stay_codes_only_where_they_may(coded):
    assert set(quantised(coded, coded=True)) == {CODES, CODEBOOK}
    (name,) = quantised(coded)
    assert name == "descriptor_i8"
    assert np.abs(Descriptors(quantised(coded)[name])[:] - coded[:]).max() < 0.02


def _file(path, coded, **other):
    arrays = {"id": np.arange(M), **coded.arrays(), **other}
    save_file({k: np.ascontiguousarray(v) for k, v in arrays.items() if v is not None}, path)
    return path


def test_they_are_mapped_from_a_file_and_not_read(coded, tmp_path):
    path = _file(tmp_path / "landmarks.safetensors", coded)
    kept = open_descriptors(path, M, STRETCHES * NUMBERS)
    assert isinstance(kept, CodedDescriptors) and isinstance(kept.codes, np.memmap)
    assert not kept.codes.flags.writeable
    assert np.array_equal(kept[:], coded[:])
    none = CodedDescriptors(coded.codes[:0], coded.codebook)
    path = _file(tmp_path / "none.safetensors", none)
    assert open_descriptors(path, 0, STRETCHES * NUMBERS)[:].shape == (0, STRETCHES * NUMBERS)


def _with(array, at, value):
    array = array.copy()
    array[at] = value
    return array


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: {CODES: _with(c.codes, (3, 1), WORDS)}, "a code of none of the 5 words"),
        (lambda c: {CODES: _with(c.codes, (M - 1, 3), 255)}, "a code of none of the 5 words"),
        (lambda c: {CODEBOOK: _with(c.codebook, (1, 2, 0), np.nan)}, "'descriptor_codebook' holds"),
        (lambda c: {CODEBOOK: _with(c.codebook, (1, 2, 0), np.inf)}, "not finite"),
        (lambda c: {CODEBOOK: c.codebook.astype(np.float32)}, "must be float16, not F32"),
        (lambda c: {CODEBOOK: c.codebook[:3]}, "are no descriptors"),
        (lambda c: {CODEBOOK: c.codebook[:, :0]}, "are no descriptors"),
        (lambda c: {CODEBOOK: c.codebook[0]}, "are no descriptors"),
        (lambda c: {CODEBOOK: np.repeat(c.codebook, 60, axis=1)}, "are no descriptors"),
        (lambda c: {CODEBOOK: None}, "'descriptor_codebook' is missing"),
        (lambda c: {CODES: c.codes[:-1]}, "are no descriptors"),
        (lambda c: {CODES: c.codes.ravel()}, "are no descriptors"),
        (lambda c: {CODES: c.codes.astype(np.int8)}, "must be uint8, not I8"),
        (lambda c: {CODES: None, CODEBOOK: None}, "holds no descriptors"),
    ],
)
def test_what_is_no_whole_code_is_refused_in_one_line(coded, tmp_path, change, words):
    path = _file(tmp_path / "landmarks.safetensors", coded, **change(coded))
    with pytest.raises(MapError, match=words) as caught:
        open_descriptors(path, M, STRETCHES * NUMBERS)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_that_was_cut_is_refused(coded, tmp_path):
    path = _file(tmp_path / "landmarks.safetensors", coded)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(MapError, match=r"landmarks\.safetensors"):
        open_descriptors(path, M, STRETCHES * NUMBERS)
