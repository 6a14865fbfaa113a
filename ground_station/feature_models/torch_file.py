"""Files of `torch.save` and of safetensors, read without torch; nothing in a file is executed.

Both of torch's formats: the zip archive that it writes since 1.6, and the row of pickles before,
in which `superpoint_v1.pth` (2018) is. What they look like stands in torch/serialization.py.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from ground_station.feature_models import pickle_subset, torch_tensors
from ground_station.feature_models.pickle_subset import PickleError, shown
from ground_station.feature_models.torch_tensors import Storage
from ground_station.feature_models.weights import Weights, WeightsError

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
            storages: dict[str, Storage] = {}
            value, _ = pickle_subset.load(
                text, 0, torch_tensors.names(), torch_tensors.keeper(storages, 5)
            )
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
    return torch_tensors.views(value, contents)


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
    storages: dict[str, Storage] = {}
    value, at = pickle_subset.load(
        data, at, torch_tensors.names(), torch_tensors.keeper(storages, 6)
    )
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
    return torch_tensors.views(value, contents)


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
