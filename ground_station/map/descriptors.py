"""A map's descriptors as they lie in its file: a byte a number or less, read when asked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.arrays import F32, Bools, Indices
from ground_station.errors import MapError

NAMES: dict[str, tuple[np.dtype[Any], str]] = {
    "descriptor": (np.dtype("<f4"), "F32"),
    "descriptor_u8": (np.dtype("u1"), "U8"),
    "descriptor_i8": (np.dtype("i1"), "I8"),
}
"""Arrays of `landmarks.safetensors` that may hold the descriptors, their types, and their names."""

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
            for name, (dtype, _) in NAMES.items()
            if dtype.itemsize == 1 and self._kept.dtype == dtype
        }


def joined(first: F32 | Descriptors, second: F32 | Descriptors) -> F32 | Descriptors:
    """The rows of both, one after the other; where the first are bytes, they stay as they are."""
    if not len(second):
        return first
    if isinstance(first, Descriptors):
        values, more = first.values, next(iter(quantised(second).values()))
        if values.dtype == more.dtype:
            return Descriptors(np.concatenate([values, more]))
    return np.concatenate([first[:], second[:]])


def rows_of(descriptors: F32 | Descriptors, index: Indices | Bools) -> F32 | Descriptors:
    """Those of an index or a mask on the first axis: codes stay codes."""
    if isinstance(descriptors, Descriptors):
        return descriptors.rows(index)
    return descriptors[index]


def quantised(descriptors: F32 | Descriptors) -> dict[str, npt.NDArray[Any]]:
    """Rows (M, D) with a byte a number, by the name of their array in a map's file.

    Each row is scaled to its own maximum: rows are unit vectors, so the scale is found again by
    normalising. What is quantised already stays as it is.
    """
    if isinstance(descriptors, Descriptors):
        kept = descriptors.arrays()
        if kept:
            return kept
        descriptors = descriptors[:]
    signed = bool((descriptors < 0).any())
    return {"descriptor_i8" if signed else "descriptor_u8": _bytes(descriptors, signed)}


def _bytes(rows: F32, signed: bool) -> npt.NDArray[Any]:
    top = np.maximum(np.abs(rows).max(axis=1, keepdims=True, initial=0), 1e-12)
    if signed:
        return np.asarray(np.round(rows * 127 / top), np.int8)
    return np.asarray(np.round(rows * 255 / top), np.uint8)


def _unit(rows: F32) -> F32:
    rows /= np.maximum(np.sqrt(np.vecdot(rows, rows)), 1e-12)[..., None]
    return rows


def open_descriptors(path: Path, count: int, dimension: int, prefix: str = "") -> Descriptors:
    """Maps the descriptors (count, dimension) of a map's file into memory without reading them.

    The prefix stands before their array's name. The rest of the file has been checked by
    safetensors' own reader. Raises `MapError` when they are missing, of another size or type, or
    not finite. The file may be replaced by renaming while it is mapped, but not be written to.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
            found = next((name for name in NAMES if prefix + name in header), None)
            if found is None:
                raise MapError(f"{path}: it holds no {prefix}descriptors")
            name = prefix + found
            entry, (dtype, kind) = header[name], NAMES[found]
            shape, (begin, end) = tuple(entry["shape"]), entry["data_offsets"]
            if shape != (count, dimension):
                raise MapError(f"{path}: descriptors are {shape}, not ({count}, {dimension})")
            if entry["dtype"] != kind:
                raise MapError(f"{path}: '{name}' must be {dtype}, not {entry['dtype']}")
            if end - begin != count * dimension * dtype.itemsize:
                raise MapError(f"{path}: '{name}' has {end - begin} bytes")
            values = (
                np.memmap(file, dtype, "r", 8 + length + begin, shape)
                if begin < end
                else np.empty(shape, dtype)  # nothing cannot be mapped
            )
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
