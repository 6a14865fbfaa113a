"""`ground_station.feature_models`: files of torch.save and safetensors, and what they become.

Nothing in a file is executed: the only functions that a pickle reaches are the reader's own.
"""

from __future__ import annotations

import struct

import numpy as np
import torch_files as made
from pieces import Picker, blocks, refusing, scratch, stretch
from safetensors.numpy import save

from ground_station.feature_models import alike, superpoint, torch_file
from ground_station.feature_models.torch_file import WeightsError
from readers import safetensors_file
from readers.safetensors_file import array

_FILE = scratch("weights") / "weights.pth"
_MOST_VALUES = 1 << 16
_TENSORS = {
    "conv1a.weight": np.zeros((2, 1, 3, 3), np.float32),
    "conv1a.bias": np.ones(2, np.float32),
    "block1.conv1.weight": np.ones((8, 3, 1, 1), np.float32),
    "convhead2.weight": np.ones(4, np.float32),
}
_LAYOUT = {"conv1a.weight": array("F32", (2, 1, 3, 3), 1), "conv1a.bias": array("F32", (2,))}
_PIECES = (
    b"}", b"]", b")", b"(", b"N", b"\x88", b"t", b"\x85", b"\x86", b"s", b"u", b"e", b"a", b"R",
    b"b", b"q\x00", b"h\x00", b"\x94", b"0", b"2", b"Q", made.text("a"), made.text("state_dict"),
    made.number(0), made.number(2**62), made.name("torch", "FloatStorage"),
    made.name("torch._utils", "_rebuild_tensor_v2"), made.name("collections", "OrderedDict"),
    made.name("torch._utils", "_rebuild_parameter"), made.name("os", "system"),
    made.storage("0", np.dtype("f4"), 2), made.storage("0", np.dtype("f4"), 2, True),
    made.tensor(made.storage("0", np.dtype("f4"), 18), (2, 9), (9, 1)),
)  # fmt: skip
_NUMBERS = (0, 1, 2, 17, 18, 19, -1, 2**31, 2**40, 2**62, 2**63 - 1)


def _body(picker: Picker) -> bytes:
    """A pickle's opcodes: pieces that fit together, and some that do not."""
    body = b""
    for _ in range(min(picker.number(1), picker.left())):
        choice = picker.number(1)
        body += _PIECES[choice] if choice < len(_PIECES) else picker.bytes(choice % 8)
    return body


def _tensors(picker: Picker) -> bytes:
    """A dictionary of one tensor whose extents are anything."""
    extents = [[picker.of(_NUMBERS) for _ in range(picker.number(1) % 5)] for _ in range(2)]
    source = made.storage("0", np.dtype("f4"), picker.of(_NUMBERS), bool(picker.number(1) % 2))
    return b"}" + made.text("a") + made.tensor(source, *extents, picker.of(_NUMBERS)) + b"s"


def _file(picker: Picker) -> bytes:
    how = picker.number(1) % 8
    if how == 0:
        return picker.rest()
    if how == 1:
        return safetensors_file.build(picker, _LAYOUT, {"format": "pt"})
    if how == 2:
        data = bytearray(picker.of((made.zip_of(_TENSORS), made.legacy_of(_TENSORS))))
        while picker.left():
            data[picker.number(2) % len(data)] ^= picker.number(1)
        return bytes(data)
    pickle = made.pickled(_tensors(picker) if how < 5 else _body(picker), 2 + picker.number(1) % 3)
    storages = {"0": picker.block() or bytes(72)}
    if how % 2:
        return made.as_zip(pickle, storages)
    return made.as_legacy(pickle, storages)


def fuzz(data: bytes) -> None:
    """Tensors are views within the file; a network is built from no other than its own."""
    content = _file(Picker(data))
    _FILE.write_bytes(content)
    with refusing(WeightsError):
        weights = torch_file.read(_FILE)
        for tensor in weights.tensors.values():
            assert tensor.nbytes <= len(content) and not tensor.dtype.hasobject
            assert tensor.size <= _MOST_VALUES or len(content) > _MOST_VALUES
            tensor.tobytes()
        for network in (superpoint, alike):
            with refusing(WeightsError):
                if network.recognises(weights):
                    network.build(weights)


def seeds() -> list[bytes]:
    """A whole file of each kind, tensors that reach out, opcodes, and what grows."""
    return [
        b"\0" + made.zip_of(_TENSORS),
        b"\0" + made.legacy_of(_TENSORS),
        b"\0" + made.legacy_of(_TENSORS, python2=True),
        b"\0" + save(_TENSORS),
        b"\1",
        b"\2\1" + struct.pack("<HB", 40, 255),
        b"\3\1\4\1\2\4\0\0" + blocks(bytes(72)),
        b"\4\2\2\1\2\1\0\4\1\0" + blocks(bytes(72)),
        b"\5\x10" + bytes(range(16)),
        b"\6\x08\x00\x15\x20\x09",
        b"\7\x05\x1d\x15\x07\x0d\x00",
        stretch((1, b"\0\x80\x02"), (30_000, b"]")),
        stretch((1, b"\0\x80\x02\x8a\x0a" + made.MAGIC.to_bytes(10, "little") + b"."),
                (30_000, b")\x85")),
    ]  # fmt: skip
