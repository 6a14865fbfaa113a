"""Tensors as PyTorch's pickles describe them: stretches of storages that lie outside the pickle.

Every extent is checked against its storage before there is an array (torch/_utils.py says what
the calls in a file mean).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ground_station.feature_models import pickle_subset
from ground_station.feature_models.pickle_subset import Name, PickleError, shown

_MOST_DIMENSIONS = 8
_MOST_VALUES = 1 << 29
_NESTED = ("state_dict", "model_state_dict", "model")
"""Under which a checkpoint of a training keeps the weights."""

_TYPES = {
    "FloatStorage": np.dtype("<f4"), "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"), "LongStorage": np.dtype("<i8"), "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"), "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"), "BoolStorage": np.dtype("?"),
}  # fmt: skip


@dataclass(frozen=True)
class Storage:
    """A stretch of numbers outside the pickle; legacy files give its bytes after the pickle."""

    key: str
    dtype: np.dtype[Any]
    count: int


@dataclass(frozen=True)
class _Tensor:
    """What `torch._utils._rebuild_tensor_v2` is asked for; checked against the storage later."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def names() -> dict[tuple[str, str], Name]:
    """All that a file of tensors names, for `pickle_subset.load`."""
    found = {("torch", name): Name(dtype) for name, dtype in _TYPES.items()}
    found["collections", "OrderedDict"] = Name(_ordered_dict)
    found["torch._utils", "_rebuild_tensor"] = Name(_tensor)
    found["torch._utils", "_rebuild_tensor_v2"] = Name(_tensor)
    found["torch._utils", "_rebuild_parameter"] = Name(_parameter)
    return found


def _ordered_dict(*arguments: Any) -> dict[Any, Any]:
    """Empty, as Python 3 writes it, or of [key, value] lists, as Python 2 does."""
    pairs = arguments[0] if len(arguments) == 1 else []
    if len(arguments) > 1 or not isinstance(pairs, list):
        raise PickleError("an OrderedDict in it is made of no list")
    made: dict[Any, Any] = {}
    for pair in pairs:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise PickleError("an OrderedDict in it is made of no pairs")
        pickle_subset.set_item(made, *pair)
    return made


def _tensor(*arguments: Any) -> _Tensor:
    storage, offset, size, stride = arguments[:4] if len(arguments) >= 4 else (None,) * 4
    if (
        not isinstance(storage, Storage)
        or not isinstance(offset, int)
        or not _extents(size)
        or not _extents(stride)
        or len(size) != len(stride)
    ):
        raise PickleError("a tensor in it is described by other things than numbers")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if not 0 <= offset <= storage.count or (0 not in size and last >= storage.count):
        raise PickleError(f"a tensor reaches beyond its storage {shown(storage.key)}")
    # An extent of stride 0 would let a few bytes claim any size.
    count = 1
    for extent in size:
        count *= extent
    if count > storage.count:
        raise PickleError(f"a tensor is larger than its storage {shown(storage.key)}")
    return _Tensor(storage, offset, size, stride)


def _extents(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) <= _MOST_DIMENSIONS
        and all(type(extent) is int and 0 <= extent < _MOST_VALUES for extent in value)
    )


def _parameter(*arguments: Any) -> _Tensor:
    if not arguments or not isinstance(arguments[0], _Tensor):
        raise PickleError("a parameter in it is no tensor")
    return arguments[0]


def keeper(storages: dict[str, Storage], length: int) -> Callable[[Any], Storage]:
    """Takes the identities of storages into `storages`, for `pickle_subset.load`.

    They are ("storage", type, key, device, count), and a view of another where `length` is 6.
    """

    def keep(identity: Any) -> Storage:
        if not isinstance(identity, tuple) or len(identity) != length or identity[0] != "storage":
            raise PickleError("it holds something else than tensors' storages")
        kind, key, _, count = identity[1:5]
        if not isinstance(kind, Name) or not isinstance(kind.meaning, np.dtype):
            raise PickleError("a storage in it is of no known type")
        if not isinstance(key, str) or type(count) is not int or not 0 <= count <= _MOST_VALUES:
            raise PickleError("a storage in it has no key or no size")
        if length == 6 and identity[5] is not None:
            raise PickleError(f"the storage {shown(key)} is a view of another")
        storage = Storage(key, kind.meaning, count)
        if storages.setdefault(key, storage) != storage:
            raise PickleError(f"the storage {shown(key)} is described twice, not the same")
        return storage

    return keep


def views(value: Any, contents: Mapping[str, bytes | memoryview]) -> dict[str, npt.NDArray[Any]]:
    """The tensors of a state dictionary, or of the one that a checkpoint holds, by name.

    They are views of `contents`, the bytes of the storages by key. Raises `PickleError`.
    """
    for key in _NESTED:
        if isinstance(value, dict) and isinstance(value.get(key), dict):
            value = value[key]
    if not isinstance(value, dict):
        raise PickleError("it holds no dictionary of tensors")
    found = {}
    for name, tensor in value.items():
        if not isinstance(name, str) or not isinstance(tensor, _Tensor):
            continue
        storage = tensor.storage
        content = contents.get(storage.key, b"")
        if len(content) != storage.count * storage.dtype.itemsize:
            raise PickleError(f"the storage {shown(storage.key)} has another size than it says")
        step = storage.dtype.itemsize
        strides = tuple(extent * step for extent in tensor.stride)
        found[name] = np.ndarray(tensor.size, storage.dtype, content, tensor.offset * step, strides)
    if not found:
        raise PickleError("it holds no tensors by name")
    return found
