"""Files as `torch.save` writes them, made without torch: pickles opcode by opcode.

Whether torch writes them so was checked with torch 2.13 itself, both formats, protocols 2 to 5.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

MAGIC = 0x1950A86A20F9469CFC6C
_STORAGES = {"f4": "Float", "f8": "Double", "f2": "Half", "i8": "Long", "u1": "Byte"}

Tensors = Mapping[str, npt.NDArray[Any]]


def text(value: str) -> bytes:
    """BINUNICODE: text of Python 3."""
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def old_text(value: str) -> bytes:
    """SHORT_BINSTRING: text of Python 2."""
    return b"U" + bytes([len(value)]) + value.encode()


def number(value: int) -> bytes:
    """The shortest opcode, as the pickler chooses."""
    if 0 <= value < 256:
        return b"K" + bytes([value])
    if 0 <= value < 65536:
        return b"M" + struct.pack("<H", value)
    if -(2**31) <= value < 2**31:
        return b"J" + struct.pack("<i", value)
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def name(module: str, attribute: str) -> bytes:
    """GLOBAL."""
    return f"c{module}\n{attribute}\n".encode()


def group(items: Iterable[bytes]) -> bytes:
    """A tuple after a mark."""
    return b"(" + b"".join(items) + b"t"


def extents(values: Iterable[int]) -> bytes:
    """A size or a stride."""
    return group(map(number, values))


def storage(key: str, dtype: np.dtype[Any], count: int, legacy: bool = False) -> bytes:
    """A persistent identity: BINPERSID of a storage."""
    kind = name("torch", f"{_STORAGES[dtype.str[1:]]}Storage")
    parts = [text("storage"), kind, text(key), text("cpu"), number(count)]
    return group([*parts, b"N"] if legacy else parts) + b"Q"


def tensor(source: bytes, size: Iterable[int], stride: Iterable[int], offset: int = 0) -> bytes:
    """A call of torch._utils._rebuild_tensor_v2."""
    hooks = name("collections", "OrderedDict") + b")R"
    parts = [source, number(offset), extents(size), extents(stride), b"\x89", hooks]
    return name("torch._utils", "_rebuild_tensor_v2") + group(parts) + b"R"


def contiguous(array: npt.NDArray[Any]) -> list[int]:
    """The strides of an array in C order, in elements."""
    return [stride // array.itemsize for stride in np.ascontiguousarray(array).strides]


def state(tensors: Tensors, legacy: bool = False) -> bytes:
    """A state dictionary, with its `_metadata`, as Python 3 pickles it; key k is storage k."""
    made = name("collections", "OrderedDict") + b")R" + b"q\x00("
    for key, (label, array) in enumerate(tensors.items()):
        source = storage(str(key), array.dtype, array.size, legacy)
        made += text(label) + tensor(source, array.shape, contiguous(array))
    metadata = name("collections", "OrderedDict") + b")R(" + text("") + b"}" + b"u"
    return made + b"u}(" + text("_metadata") + metadata + b"ub"


def old_state(tensors: Tensors) -> bytes:
    """The same as Python 2 pickles it: an OrderedDict of a list of [key, value]."""
    pairs = b"".join(
        b"]("
        + old_text(label)
        + tensor(storage(str(key), array.dtype, array.size, True), array.shape, contiguous(array))
        + b"e"
        for key, (label, array) in enumerate(tensors.items())
    )
    return name("collections", "OrderedDict") + b"](" + pairs + b"e\x85R"


def pickled(body: bytes, protocol: int = 2) -> bytes:
    """A whole pickle."""
    return b"\x80" + bytes([protocol]) + body + b"."


def contents(tensors: Tensors) -> dict[str, bytes]:
    """The storages' bytes by key."""
    return {str(key): array.tobytes() for key, array in enumerate(tensors.values())}


def as_zip(
    pickle: bytes, storages: Mapping[str, bytes], kind: int = zipfile.ZIP_STORED, **more: bytes
) -> bytes:
    """The archive that torch 1.6 and newer write."""
    file = io.BytesIO()
    entries = {"data.pkl": pickle, "byteorder": more.get("byteorder", b"little")}
    entries |= {f"data/{key}": data for key, data in storages.items()} | {"version": b"3\n"}
    with zipfile.ZipFile(file, "w") as archive:
        for label, data in entries.items():  # without the time, as torch writes them
            archive.writestr(zipfile.ZipInfo(f"archive/{label}"), data, kind)
    return file.getvalue()


def as_legacy(
    pickle: bytes,
    storages: Mapping[str, bytes],
    itemsize: int = 4,
    magic: bytes = b"",
    machine: bytes = b"",
    keys: bytes = b"",
) -> bytes:
    """The row of pickles that torch wrote before, and the storages after it."""
    names = b"](" + b"".join(map(text, storages)) + b"e"
    little = b"}(" + text("protocol_version") + number(1001) + text("little_endian") + b"\x88u"
    made = magic or pickled(number(MAGIC))
    made += pickled(number(1001)) + (machine or pickled(little)) + pickle + (keys or pickled(names))
    for data in storages.values():
        made += struct.pack("<q", len(data) // itemsize) + data
    return made


def zip_of(tensors: Tensors) -> bytes:
    """A state dictionary in today's format."""
    return as_zip(pickled(state(tensors)), contents(tensors))


def legacy_of(tensors: Tensors, python2: bool = False) -> bytes:
    """A state dictionary of float32 in the format of 2018."""
    body = old_state(tensors) if python2 else state(tensors, legacy=True)
    return as_legacy(pickled(body), contents(tensors))
