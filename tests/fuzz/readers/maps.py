"""`ground_station.mapping.store`: a map's folder."""

from __future__ import annotations

import struct

import numpy as np
import tomli_w
from pieces import Picker, blocks, refusing, scratch, stretch

from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.mapping import store
from readers import safetensors_file
from readers.safetensors_file import array

_FOLDER = scratch("maps") / "map"
_FOLDER.mkdir()
_LANDMARKS = {
    "id": array("I64", (2,)), "position_m": array("F64", (2, 3), 1),
    "covariance_m2": array("F32", (2, 3, 3), 1), "spread": array("F32", (2,)),
    "view_direction": array("F32", (2, 3)), "view_cos": array("F32", (2,)),
    "distance_m": array("F32", (2, 2)), "observations": array("I32", (2,), 2),
    "descriptor_u8": array("U8", (2, 4), 7),
}  # fmt: skip
_KEYFRAMES = {
    "time_ns": array("I64", (1,)), "wTc": array("F64", (1, 4, 4)),
    "offset": ("I64", (2,), struct.pack("<qq", 0, 1)), "landmark": array("I32", (1,)),
    "pixel_px": array("F32", (1, 2), 5),
}  # fmt: skip
INFO = tomli_w.dumps(
    {
        "format": store.FORMAT,
        "name": "hall",
        "features": {"name": "rootsift", "sha256": "0" * 64, "dimension": 4},
        "camera": Camera().as_dict(),
        "built": {"seed": 1},
    }
).encode()


def fuzz(data: bytes) -> None:
    """A map that is taken fits together: every index is inside, every number finite."""
    picker = Picker(data)
    (_FOLDER / "map.toml").write_bytes(picker.block() if picker.number(1) % 2 else INFO)
    if picker.number(1) % 8 == 7:
        landmarks = picker.rest()
    else:
        landmarks = safetensors_file.build(picker, _LANDMARKS, {"format": "1"})
    (_FOLDER / "landmarks.safetensors").write_bytes(landmarks)
    keyframes = safetensors_file.build(picker, _KEYFRAMES, {"format": "1", "names": "a"})
    (_FOLDER / "keyframes.safetensors").write_bytes(keyframes)
    with refusing(MapError):
        store.load_info(_FOLDER)
    with refusing(MapError):
        store.load_positions(_FOLDER)
    with refusing(MapError):
        read = store.load(_FOLDER)
        assert np.isfinite(read.landmarks.position_m).all()
        assert len(read.keyframes.offset) == len(read.keyframes) + 1
        descriptor = np.asarray(read.landmarks.descriptor)
        assert descriptor.shape == (len(read.landmarks), read.info.dimension)


def seeds() -> list[bytes]:
    """A whole map, its map.toml as text, and tables that are too much."""
    head = b"\1" + blocks(INFO)
    big = b"\1" + blocks(INFO.replace(b"dimension = 4", b"dimension = 0x" + b"f" * 20))
    endless = b"\1" + blocks(INFO.replace(b"dimension = 4", b"dimension = inf"))
    short = b"\0\7" + b"\xff" * 8 + b"{}"
    return [b"\0\0", head, big, endless, short, stretch((1, b"\1\xff\xff"), (30_000, b"a."))]
