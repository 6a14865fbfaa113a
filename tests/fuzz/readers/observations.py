"""`ground_station.map.observations`: what a flight saw, for the map's refinement."""

from __future__ import annotations

import json
import struct

import numpy as np
from pieces import Picker, refusing, scratch

from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map.observations import FORMAT, KIND, load_observations
from readers import safetensors_file
from readers.safetensors_file import array

_FILE = scratch("observations") / "flight.safetensors"
_LAYOUT = {
    "time_ns": array("I64", (1,), 5),
    "wTc": ("F64", (1, 4, 4), np.eye(4).tobytes()),
    "offset": ("I64", (2,), struct.pack("<qq", 0, 1)),
    "landmark": array("I64", (1,)),
    "pixel_px": array("F32", (1, 2), 5),
}
_METADATA = {
    "kind": KIND, "format": str(FORMAT), "name": "flight", "map": "hall",
    "landmarks_sha256": "0" * 64, "camera": json.dumps(Camera().as_dict()),
}  # fmt: skip


def fuzz(data: bytes) -> None:
    """What is taken fits together."""
    picker = Picker(data)
    metadata = dict(_METADATA)
    if picker.number(1) % 2:
        metadata["camera"] = picker.block().decode("latin-1")
    _FILE.write_bytes(safetensors_file.build(picker, _LAYOUT, metadata))
    with refusing(MapError):
        seen = load_observations(_FILE)
        assert np.isfinite(seen.wTc).all() and len(seen.offset) == len(seen) + 1


def seeds() -> list[bytes]:
    """A whole file, and cameras that are none."""
    deep = b"[" * 2000
    return [b"\0", *(b"\1" + struct.pack("<H", len(t)) + t for t in (b'{"k1":1e999}', deep, b"[]"))]
