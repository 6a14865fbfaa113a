"""Files of `torch.save` and of safetensors, read without torch; nothing in a file is executed.

Both of torch's formats: the zip archive that it writes since 1.6, and the row of pickles before,
in which `superpoint_v1.pth` (2018) is. What they look like stands in torch/serialization.py, what
the calls in a pickle mean in torch/_utils.py. A tensor is a stretch of a storage, which lies
outside the pickle; every extent is checked against its storage before there is an array.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from ground_station.arrays import F32
from ground_station.feature_models import pickle_subset
from ground_station.feature_models.pickle_subset import Name, PickleError, shown
from ground_station.features.extractor import FeatureError

Shape = tuple[int, ...]

MOST_BYTES: Final = 512 << 20
"""Of a file; SuperPoint's has 5 MB."""
_PIECE_BYTES = 1 << 20
_MOST_ENTRIES = 10_000
"""Of an archive: one for each tensor. The zipfile module makes an object of each there is."""
_ENTRY_BEGINS = b"PK\x01\x02"
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_BEGINS = b"\x8a\x0a" + _LEGACY_MAGIC.to_bytes(10, "little")
"""After the pickle's protocol, and from protocol 4 on its frame."""
_LEGACY_PROTOCOL = 1001

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


class WeightsError(FeatureError):
    """A weights file that is missing, cut, wrong or not what it should be; the text is one line."""


@dataclass(frozen=True)
class Weights:
    """The tensors of a file; they are views of its bytes, so that a file claims no memory."""

    path: Path
    tensors: Mapping[str, npt.NDArray[Any]]
    sha256: str = ""

    def has(self, name: str) -> bool:
        """Whether there is a tensor of that name."""
        return name in self.tensors

    def shape(self, name: str) -> Shape:
        """The shape of a tensor; raises `WeightsError` when it is missing."""
        if name not in self.tensors:
            raise WeightsError(f"{self.path}: the tensor {name} is missing")
        return self.tensors[name].shape

    def take(self, name: str, shape: Shape) -> F32:
        """A tensor of exactly that shape, finite, float32; raises `WeightsError` naming it."""
        found = self.shape(name)
        if found != shape:
            raise WeightsError(
                f"{self.path}: the tensor {name} is {_by(found)}; it should be {_by(shape)}"
            )
        tensor = self.tensors[name]
        if tensor.dtype.kind != "f":
            raise WeightsError(f"{self.path}: the tensor {name} holds {tensor.dtype}, no weights")
        # Doubles beyond the range of floats become infinite, and are refused below.
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(tensor, dtype=np.float32)
        if not np.isfinite(values).all():
            raise WeightsError(f"{self.path}: the tensor {name} has values that are not finite")
        return values

    def batch_norm(self, name: str, channels: int) -> tuple[F32, F32, F32, F32]:
        """Scale, shift, mean and variance of torch's BatchNorm2d, each (channels,)."""
        parts = ("weight", "bias", "running_mean", "running_var")
        scale, shift, mean, variance = (self.take(f"{name}.{part}", (channels,)) for part in parts)
        if (variance < 0).any():
            raise WeightsError(f"{self.path}: the tensor {name}.running_var has negative values")
        return scale, shift, mean, variance


def _by(shape: Shape) -> str:
    return "x".join(map(str, shape[:8])) + ("…" if len(shape) > 8 else "") if shape else "a number"


def read(path: str | Path) -> Weights:
    """The tensors of a PyTorch or safetensors file.

    Raises `WeightsError` with one line for a file that is missing, cut, damaged or of another kind,
    or that names anything besides tensors.
    """
    path = Path(path)
    try:
        data = bytearray()
        with path.open("rb") as file:  # in pieces: what is asked for at once is allocated at once
            while piece := file.read(_PIECE_BYTES):
                data += piece
                if len(data) > MOST_BYTES:
                    raise WeightsError(f"{path}: more than {MOST_BYTES >> 20} MB")
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from None
    try:
        return Weights(path, tensors(bytes(data)), hashlib.sha256(data).hexdigest())
    except PickleError as error:
        raise WeightsError(f"{path}: {error}") from None


def tensors(data: bytes) -> dict[str, npt.NDArray[Any]]:
    """Views of the tensors in a file's bytes; raises `PickleError` with a part of a line."""
    if data.startswith(b"PK\x03\x04"):
        return _from_zip(data)
    if data[:1] == b"\x80" and _LEGACY_BEGINS in data[: len(_LEGACY_BEGINS) + 11]:
        return _from_legacy(data)
    if data[8:9] == b"{":
        return _from_safetensors(data)
    raise PickleError("no file of PyTorch or safetensors")


def _from_zip(data: bytes) -> dict[str, npt.NDArray[Any]]:
    if (entries := data.count(_ENTRY_BEGINS)) > _MOST_ENTRIES:
        raise PickleError(f"the archive has {entries} files; at most {_MOST_ENTRIES}")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
            pickles = [n for n in names if n.count("/") == 1 and n.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise PickleError("a zip archive, but none of torch.save")
            root = pickles[0].removesuffix("data.pkl")
            if f"{root}constants.pkl" in names:
                raise PickleError("a TorchScript program; only weights are read")
            if f"{root}byteorder" in names and _entry(archive, f"{root}byteorder", 16) != b"little":
                raise PickleError("its numbers are big-endian")
            text = _entry(archive, pickles[0], pickle_subset.MOST_BYTES)
            storages: dict[str, _Storage] = {}
            value, _ = pickle_subset.load(text, 0, _names(), _keeper(storages, 5))
            contents, left = {}, len(data)
            for key, storage in storages.items():
                size = storage.count * storage.dtype.itemsize
                contents[key] = _entry(archive, f"{root}data/{key}", min(size, left))
                left -= size
    # zipfile says NotImplementedError of a compression that it does not know.
    except (zipfile.BadZipFile, NotImplementedError, EOFError, struct.error) as error:
        raise PickleError(f"a damaged zip archive ({shown(str(error))})") from None
    except (OSError, ValueError, OverflowError, KeyError, RuntimeError) as error:
        # What the zipfile module stumbles over in a directory that lies.
        if isinstance(error, PickleError):
            raise
        raise PickleError(f"a damaged zip archive ({type(error).__name__})") from None
    return _views(value, contents)


def _entry(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """A file in the archive, its sum checked; torch compresses none, and so none can grow."""
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise PickleError(f"the archive has no {shown(name)}") from None
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise PickleError(f"{shown(name)} is compressed, as torch writes none")
    if info.file_size > most:
        raise PickleError(f"{shown(name)} has {info.file_size} bytes; at most {most}")
    return archive.read(info)


def _from_legacy(data: bytes) -> dict[str, npt.NDArray[Any]]:
    at = 0
    head = []
    for _ in range(3):  # a magic number, the format's version, and the writer's machine
        value, at = pickle_subset.load(data, at, {})
        head.append(value)
    if head[:2] != [_LEGACY_MAGIC, _LEGACY_PROTOCOL]:
        raise PickleError(f"its format is {shown(head[1])}; known is {_LEGACY_PROTOCOL}")
    if not isinstance(head[2], dict) or head[2].get("little_endian") is not True:
        raise PickleError("its numbers are big-endian")
    storages: dict[str, _Storage] = {}
    value, at = pickle_subset.load(data, at, _names(), _keeper(storages, 6))
    keys, at = pickle_subset.load(data, at, {})
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise PickleError("its list of storages is none")
    contents: dict[str, bytes | memoryview] = {}
    for key in keys:
        if key not in storages or key in contents:
            raise PickleError(f"the storage {shown(key)} belongs to no tensor")
        count = int.from_bytes(data[at : at + 8], "little", signed=True)
        size = storages[key].count * storages[key].dtype.itemsize
        if len(data) < at + 8 + size:
            raise PickleError("it is cut")
        if count != storages[key].count:
            raise PickleError(f"the storage {shown(key)} has another size than its tensors say")
        contents[key] = memoryview(data)[at + 8 : at + 8 + size]
        at += 8 + size
    if at != len(data):
        raise PickleError(f"{len(data) - at} bytes follow the last tensor")
    return _views(value, contents)


def _from_safetensors(data: bytes) -> dict[str, npt.NDArray[Any]]:
    header = int.from_bytes(data[:8], "little")
    if header > pickle_subset.MOST_BYTES:
        raise PickleError(
            f"it describes its tensors in {header} bytes; at most {pickle_subset.MOST_BYTES}"
        )
    try:
        return load_safetensors(data)
    except SafetensorError as error:
        raise PickleError(f"a damaged safetensors file ({shown(str(error))})") from None
    except (KeyError, TypeError, ValueError):  # of a type that numpy lacks
        raise PickleError("a tensor in it is of a type that no weights have") from None


@dataclass(frozen=True)
class _Storage:
    """A stretch of numbers outside the pickle; legacy files give its bytes after the pickle."""

    key: str
    dtype: np.dtype[Any]
    count: int


@dataclass(frozen=True)
class _Tensor:
    """What `torch._utils._rebuild_tensor_v2` is asked for; checked against the storage later."""

    storage: _Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def _names() -> dict[tuple[str, str], Name]:
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
        not isinstance(storage, _Storage)
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


def _keeper(storages: dict[str, _Storage], length: int) -> Callable[[Any], _Storage]:
    """Takes the identities of storages into `storages`, for `pickle_subset.load`.

    They are ("storage", type, key, device, count), and a view of another where `length` is 6.
    """

    def keep(identity: Any) -> _Storage:
        if not isinstance(identity, tuple) or len(identity) != length or identity[0] != "storage":
            raise PickleError("it holds something else than tensors' storages")
        kind, key, _, count = identity[1:5]
        if not isinstance(kind, Name) or not isinstance(kind.meaning, np.dtype):
            raise PickleError("a storage in it is of no known type")
        if not isinstance(key, str) or type(count) is not int or not 0 <= count <= _MOST_VALUES:
            raise PickleError("a storage in it has no key or no size")
        if length == 6 and identity[5] is not None:
            raise PickleError(f"the storage {shown(key)} is a view of another")
        storage = _Storage(key, kind.meaning, count)
        if storages.setdefault(key, storage) != storage:
            raise PickleError(f"the storage {shown(key)} is described twice, not the same")
        return storage

    return keep


def _views(value: Any, contents: Mapping[str, bytes | memoryview]) -> dict[str, npt.NDArray[Any]]:
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
