"""`ground_station.feature_models`: safetensors, and what they become.

Files of torch's are read by Python's own unpickler in a process with bounds, which is not fuzzed.
"""

from __future__ import annotations

import struct

import numpy as np
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


def _file(picker: Picker) -> bytes:
    if picker.number(1) % 4:
        return safetensors_file.build(picker, _LAYOUT, {"format": "pt"})
    header = b"{" + picker.rest()  # without the brace a program of its own reads it
    return len(header).to_bytes(8, "little") + header


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
    """A whole file, what is none, and headers of all sizes."""
    whole = save(_TENSORS)
    return [
        b"\0" + whole[9 : 8 + int.from_bytes(whole[:8], "little")],
        b"\0",
        b"\1",
        b"\2\1" + struct.pack("<HB", 40, 255),
        b"\3\1\4\1\2\4\0\0" + blocks(bytes(72)),
        stretch((1, b"\0"), (30_000, b'"a":[')),
    ]
