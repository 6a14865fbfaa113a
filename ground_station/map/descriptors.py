"""A map's descriptors as they lie in its file: a byte a number or less, read when asked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.errors import MapError

F32 = npt.NDArray[np.float32]

NAMES: dict[str, np.dtype[Any]] = {
    "descriptor": np.dtype("<f4"),
    "descriptor_u8": np.dtype("u1"),
    "descriptor_i8": np.dtype("i1"),
}
"""Arrays of `landmarks.safetensors` that may hold the descriptors, and their types."""

CODES, CODEBOOK = "descriptor_codes", "descriptor_codebook"
"""Two arrays that hold them in a compressed map instead: bytes, and what they stand for."""

_SAFETENSORS_TYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "U8": np.dtype("u1"),
    "I8": np.dtype("i1"),
}

_BLOCK = 1 << 22
"""Numbers that are looked at together: 16 MB as float32."""


class Descriptors:
    """M descriptors of D numbers, kept quantised; what is taken out are float32 unit rows.

    `values` (M, D) are uint8, int8 or float32, in memory or mapped from a file; each row counts up
    to its length. Stands in for an (M, D) float32 array: `descriptors[index]` gives rows, and where
    numpy needs an array it gets all of them.
    """

    def __init__(self, values: npt.NDArray[Any]) -> None:
        self._kept = values
        self._plain = np.asarray(values)  # a mapped array's own indexing is slower

    @property
    def values(self) -> npt.NDArray[Any]:
        """Rows (M, D) that count up to their lengths, a byte a number or float32."""
        return self._kept

    @property
    def shape(self) -> tuple[int, ...]:
        return self._kept.shape

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, index: Any) -> F32:
        """Unit rows (N, D) of an index, a slice or a mask on the first axis; (D,) of a number."""
        return _unit(np.array(self._plain[index], np.float32))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        if copy is False:
            raise ValueError("descriptors are made unit rows in a new array")
        return np.asarray(self[:], dtype)

    def rows(self, index: Any) -> Descriptors:
        """Those of an index, a slice or a mask on the first axis, quantised as they are."""
        return Descriptors(self._plain[index])

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What keeps them as they are in a map's file, by name; none of float32."""
        return {
            name: np.asarray(self._kept)
            for name, dtype in NAMES.items()
            if dtype.itemsize == 1 and self._kept.dtype == dtype
        }


class CodedDescriptors(Descriptors):
    """M descriptors as S codes each, of the nearest of C words in each of S stretches of numbers.

    `codes` (M, S) uint8, in memory or mapped from a file; `codebook` (S, C, D / S) the words.
    Product quantisation: Jégou, Douze and Schmid, TPAMI 2011.
    """

    def __init__(self, codes: npt.NDArray[np.uint8], codebook: npt.NDArray[Any]) -> None:
        super().__init__(codes)
        self.codebook = codebook
        stretches, words, numbers = codebook.shape
        self._words = np.asarray(codebook, np.float32).reshape(stretches * words, numbers)
        self._first = words * np.arange(stretches)

    @property
    def codes(self) -> npt.NDArray[np.uint8]:
        """The codes (M, S)."""
        return self._kept

    @property
    def values(self) -> npt.NDArray[Any]:
        """All of them with a byte a number, in a new array (M, D)."""
        signed = bool((self._words < 0).any())
        values = np.empty(self.shape, np.int8 if signed else np.uint8)
        step = max(1, _BLOCK // max(self.shape[1], 1))
        for start in range(0, len(values), step):
            values[start : start + step] = _bytes(self[start : start + step], signed)
        return values

    @property
    def shape(self) -> tuple[int, ...]:
        return len(self._kept), len(self._first) * self._words.shape[1]

    def __getitem__(self, index: Any) -> F32:
        words = self._words.take(self._plain[index] + self._first, axis=0)
        return _unit(words.reshape(*words.shape[:-2], self.shape[1]))

    def rows(self, index: Any) -> CodedDescriptors:
        """Those of an index, a slice or a mask on the first axis, with the same words."""
        return CodedDescriptors(self._plain[index], self.codebook)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Codes and words."""
        return {CODES: np.asarray(self._kept), CODEBOOK: np.asarray(self.codebook, np.float16)}


def joined(first: F32 | Descriptors, second: F32 | Descriptors) -> F32 | Descriptors:
    """The rows of both, one after the other; where the first are bytes, they stay as they are."""
    if not len(second):
        return first
    if isinstance(first, Descriptors):
        values, more = first.values, next(iter(quantised(second).values()))
        if values.dtype == more.dtype:
            return Descriptors(np.concatenate([values, more]))
    return np.concatenate([first[:], second[:]])


def quantised(
    descriptors: F32 | Descriptors, *, coded: bool = False
) -> dict[str, npt.NDArray[Any]]:
    """Rows (M, D) with a byte a number, by the name of their array in a map's file.

    Each row is scaled to its own maximum: rows are unit vectors, so the scale is found again by
    normalising. What is quantised already stays as it is; codes only where they may stay `coded`.
    """
    if isinstance(descriptors, Descriptors):
        kept = descriptors.arrays()
        if kept and (coded or CODES not in kept):
            return kept
        descriptors = descriptors[:]
    signed = bool((descriptors < 0).any())
    return {"descriptor_i8" if signed else "descriptor_u8": _bytes(descriptors, signed)}


def _bytes(rows: F32, signed: bool) -> npt.NDArray[Any]:
    top = np.maximum(np.abs(rows).max(axis=1, keepdims=True, initial=0), 1e-12)
    if signed:
        return np.round(rows * 127 / top).astype(np.int8)
    return np.round(rows * 255 / top).astype(np.uint8)


def _unit(rows: F32) -> F32:
    rows /= np.maximum(np.sqrt(np.vecdot(rows, rows)), 1e-12)[..., None]
    return rows


def open_descriptors(path: Path, count: int, dimension: int, prefix: str = "") -> Descriptors:
    """Maps the descriptors (count, dimension) of a map's file into memory without reading them.

    The prefix stands before their arrays' names; without words of their own they have those
    without it. The rest of the file has been checked by
    safetensors' own reader. Raises `MapError` when they are missing, of another size or type, not
    finite, or codes of no word. The file may be replaced by renaming while it is mapped, but not be
    written to.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
            found = next((name for name in (*NAMES, CODES) if prefix + name in header), None)
            if found is None:
                raise MapError(f"{path}: it holds no {prefix}descriptors")
            if found == CODES:
                codes = _mapped(file, path, header, length, prefix + CODES, "U8")
                words = prefix + CODEBOOK if prefix + CODEBOOK in header else CODEBOOK
                codebook = _mapped(file, path, header, length, words, "F16")
                return _coded(path, codes, codebook, (count, dimension))
            name = prefix + found
            shape = tuple(header[name]["shape"])
            if shape != (count, dimension):
                raise MapError(f"{path}: descriptors are {shape}, not ({count}, {dimension})")
            kind = next(k for k, dtype in _SAFETENSORS_TYPES.items() if dtype == NAMES[found])
            values = _mapped(file, path, header, length, name, kind)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MapError(f"{path}: {reason}") from None
    # Bytes are always numbers; floating point must be looked at.
    if values.dtype.kind == "f":
        rows = max(1, _BLOCK // max(dimension, 1))
        for start in range(0, count, rows):
            if not np.isfinite(values[start : start + rows]).all():
                raise MapError(f"{path}: '{name}' holds a value that is not finite")
    return Descriptors(values)


def _mapped(
    file: Any, path: Path, header: dict[str, Any], length: int, name: str, kind: str
) -> npt.NDArray[Any]:
    """An array of a file whose header has `length` bytes, mapped into memory."""
    if name not in header:
        raise MapError(f"{path}: the array '{name}' is missing")
    entry, dtype = header[name], _SAFETENSORS_TYPES[kind]
    shape = tuple(entry["shape"])
    if entry["dtype"] != kind:
        raise MapError(f"{path}: '{name}' must be {dtype}, not {entry['dtype']}")
    begin, end = entry["data_offsets"]
    if end - begin != int(np.prod(shape, dtype=object)) * dtype.itemsize:
        raise MapError(f"{path}: '{name}' has {end - begin} bytes")
    if begin == end:  # nothing cannot be mapped
        return np.empty(shape, dtype)
    return np.memmap(file, dtype, "r", 8 + length + begin, shape)


def _coded(
    path: Path, codes: npt.NDArray[Any], codebook: npt.NDArray[Any], shape: tuple[int, int]
) -> CodedDescriptors:
    """Codes and words that fit each other and the map; the words are read, the codes are not."""
    count, dimension = shape
    words = np.array(codebook)
    fits = words.ndim == 3 and words.shape[0] * words.shape[2] == dimension
    if not fits or not 0 < words.shape[1] <= 256 or codes.shape != (count, len(words)):
        raise MapError(
            f"{path}: codes {codes.shape} of words {words.shape} are no descriptors "
            f"({count}, {dimension})"
        )
    if not np.isfinite(words).all():
        raise MapError(f"{path}: '{CODEBOOK}' holds a value that is not finite")
    # A byte is always one of 256; of fewer words it must be looked at.
    rows = max(1, _BLOCK // max(len(words), 1))
    for start in range(0, count if words.shape[1] < 256 else 0, rows):
        if (codes[start : start + rows] >= words.shape[1]).any():
            raise MapError(f"{path}: '{CODES}' holds a code of none of the {words.shape[1]} words")
    return CodedDescriptors(codes, words)
