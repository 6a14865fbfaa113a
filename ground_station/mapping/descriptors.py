"""A map's descriptors as they lie in its file: a byte a number, read when they are asked for."""

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

_SAFETENSORS_TYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
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
        self.values = values
        self._plain = np.asarray(values)  # a mapped array's own indexing is slower

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: Any) -> F32:
        """Unit rows (N, D) of an index, a slice or a mask on the first axis; (D,) of a number."""
        rows = np.array(self._plain[index], np.float32)
        rows /= np.maximum(np.sqrt(np.vecdot(rows, rows)), 1e-12)[..., None]
        return rows

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        if copy is False:
            raise ValueError("descriptors are made unit rows in a new array")
        return np.asarray(self[:], dtype)


def quantised(descriptors: F32 | Descriptors) -> dict[str, npt.NDArray[Any]]:
    """Rows (M, D) with a byte a number, by the name of their array in a map's file.

    Each row is scaled to its own maximum: rows are unit vectors, so the scale is found again by
    normalising. What is quantised already stays as it is.
    """
    if isinstance(descriptors, Descriptors):
        for name, dtype in NAMES.items():
            if dtype.itemsize == 1 and descriptors.values.dtype == dtype:
                return {name: np.asarray(descriptors.values)}
        descriptors = descriptors[:]
    top = np.maximum(np.abs(descriptors).max(axis=1, keepdims=True, initial=0), 1e-12)
    if (descriptors < 0).any():
        return {"descriptor_i8": np.round(descriptors * 127 / top).astype(np.int8)}
    return {"descriptor_u8": np.round(descriptors * 255 / top).astype(np.uint8)}


def open_descriptors(path: Path, count: int, dimension: int) -> Descriptors:
    """Maps the descriptors (count, dimension) of a map's file into memory without reading them.

    The rest of the file has been checked by safetensors' own reader. Raises `MapError` when they
    are missing, of another size or type, or not finite. The file may be replaced by renaming while
    it is mapped, but not be written to.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
            name = next((name for name in NAMES if name in header), None)
            if name is None:
                raise MapError(f"{path}: it holds no descriptors")
            entry = header[name]
            shape, dtype = tuple(entry["shape"]), _SAFETENSORS_TYPES.get(entry["dtype"])
            if shape != (count, dimension):
                raise MapError(f"{path}: descriptors are {shape}, not ({count}, {dimension})")
            if dtype != NAMES[name]:
                raise MapError(f"{path}: '{name}' must be {NAMES[name]}, not {entry['dtype']}")
            begin, end = entry["data_offsets"]
            if end - begin != count * dimension * NAMES[name].itemsize:
                raise MapError(f"{path}: '{name}' has {end - begin} bytes")
            if begin == end:  # nothing cannot be mapped
                return Descriptors(np.empty(shape, NAMES[name]))
            offset = 8 + length + begin
            values = np.memmap(file, NAMES[name], "r", offset, shape)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MapError(f"{path}: {reason}") from None
    # Bytes are always numbers; floating point must be looked at.
    if values.dtype.kind == "f":
        rows = max(1, _BLOCK // dimension)
        for start in range(0, count, rows):
            if not np.isfinite(values[start : start + rows]).all():
                raise MapError(f"{path}: '{name}' holds a value that is not finite")
    return Descriptors(values)
