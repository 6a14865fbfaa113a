"""The tensors of a file that torch has written, without torch; run by `torch_file`.

Both of torch's formats: the zip archive that it writes since 1.6, and the row of pickles before,
in which `superpoint_v1.pth` (2018) is. What they look like stands in torch/serialization.py, what
the calls in a pickle mean in torch/_utils.py. Python's unpickler finds here what `_NAMES` has and
nothing else, so that no file runs anything; but it believes what a file claims of memory, and may
take for ever, so this runs as a program with bounds. From standard input to standard output, there
as safetensors; or it prints what is wrong, in a line, with status 1.
"""

from __future__ import annotations

import io
import pickle
import sys
import zipfile
from collections import OrderedDict
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from safetensors.numpy import save

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_NESTED = ("state_dict", "model_state_dict", "model")
"""Under which a checkpoint of a training keeps the weights."""


class _Storage(NamedTuple):
    """A stretch of numbers outside the pickle."""

    key: str
    dtype: np.dtype[Any]
    length: int


class _Tensor(NamedTuple):
    """What `torch._utils._rebuild_tensor_v2` is asked for, in elements of the storage."""

    storage: _Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def _tensor(*described: Any) -> _Tensor:
    return _Tensor(*described[:4])


def _parameter(tensor: Any, *_: Any) -> Any:
    return tensor


_NAMES: dict[tuple[str, str], Any] = {
    ("torch", f"{name}Storage"): np.dtype(code)
    for name, code in {
        "Float": "<f4", "Double": "<f8", "Half": "<f2", "Long": "<i8", "Int": "<i4",
        "Short": "<i2", "Char": "i1", "Byte": "u1", "Bool": "?",
    }.items()
} | {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor"): _tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
}  # fmt: skip


class _Unpickler(pickle.Unpickler):
    """Of one pickle; `storages` are those that it names, by key."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, encoding="utf-8")  # Python 2's own strings held names, too
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which no tensor needs")
        return _NAMES[module, name]

    def persistent_load(self, identity: Any) -> _Storage:
        _, dtype, key, _, length, *_ = identity  # ("storage", type, key, device, length, view of)
        return self.storages.setdefault(key, _Storage(key, dtype, length))


def tensors(data: bytes) -> dict[str, npt.NDArray[Any]]:
    """The tensors of a state dictionary, or of the one that a checkpoint holds, by name.

    Raises whatever it, Python or numpy stumbles over in a file that is damaged or hostile.
    """
    value, contents = _from_zip(data) if data.startswith(b"PK") else _from_legacy(data)
    for key in _NESTED:
        value = value.get(key, value)
    found = {}
    for name, tensor in value.items():
        if isinstance(name, str) and isinstance(
            tensor, _Tensor
        ):  # numpy holds its extents against the storage
            storage, size = tensor.storage, tensor.storage.dtype.itemsize
            strides = [step * size for step in tensor.stride]
            view = np.ndarray(
                tensor.size, storage.dtype, contents[storage.key], tensor.offset * size, strides
            )
            found[name] = np.ascontiguousarray(view).reshape(view.shape)
    return found


def _from_zip(data: bytes) -> tuple[Any, dict[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        name = next((name for name in archive.namelist() if name.endswith("/data.pkl")), "")
        if not name:
            raise ValueError("a zip archive, but none of torch.save")
        root = name.removesuffix("data.pkl")
        if f"{root}byteorder" in archive.namelist():
            _little(archive.read(f"{root}byteorder") == b"little")
        unpickler = _Unpickler(io.BytesIO(archive.read(name)))
        value = unpickler.load()
        return value, {key: archive.read(f"{root}data/{key}") for key in unpickler.storages}


def _from_legacy(data: bytes) -> tuple[Any, dict[str, bytes]]:
    file = io.BytesIO(data)
    magic, version, writer = (_Unpickler(file).load() for _ in range(3))
    if (magic, version) != (_LEGACY_MAGIC, _LEGACY_PROTOCOL):
        raise ValueError("no file of PyTorch or safetensors")
    _little(writer["little_endian"])
    unpickler = _Unpickler(file)
    value = unpickler.load()
    contents = {}
    for key in _Unpickler(file).load():
        storage = unpickler.storages[key]
        length, size = int.from_bytes(file.read(8), "little"), storage.dtype.itemsize
        contents[key] = file.read(length * size)
        if length != storage.length or len(contents[key]) < length * size:
            raise ValueError("it is cut")
    if file.read(1):
        raise ValueError("more follows the last tensor")
    return value, contents


def _little(said: bool) -> None:
    if not said:
        raise ValueError("its numbers are big-endian")


if __name__ == "__main__":
    try:
        sys.stdout.buffer.write(save(tensors(sys.stdin.buffer.read())))
    except Exception as error:  # whatever a file can do to an unpickler
        sys.exit(str(error) or type(error).__name__)
