"""`ground_station.map.store`: a map's folder."""

from __future__ import annotations

import struct

import numpy as np
import tomli_w
from pieces import Picker, blocks, refusing, scratch, stretch

from ground_station.errors import MapError
from ground_station.geometry.camera import Camera
from ground_station.map import store
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
_MODES = {"mode_landmark": array("I32", (1,)), "mode_descriptor_u8": array("U8", (1, 4), 7)}
_DOCUMENT = {
    "format": store.FORMAT,
    "name": "hall",
    "features": {"name": "rootsift", "sha256": "0" * 64, "dimension": 4},
    "camera": Camera().as_dict(),
    "built": {"seed": 1},
}
INFO = tomli_w.dumps(_DOCUMENT).encode()


def fuzz(data: bytes) -> None:
    """A map that is taken fits together: every index is inside, every number finite."""
    picker = Picker(data)
    kind = picker.number(1)
    (_FOLDER / "map.toml").write_bytes(picker.block() if kind % 2 else INFO)
    if picker.number(1) % 8 == 7:
        landmarks = picker.rest()
    else:
        layout = _LANDMARKS | (_MODES if kind & 4 else {})
        landmarks = safetensors_file.build(picker, layout, {"format": "1"})
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
        assert np.isfinite(read.landmarks.covariance_m2).all()
        assert np.isfinite(read.keyframes.pixel_px).all()
        assert len(read.keyframes.offset) == len(read.keyframes) + 1
        descriptor = np.asarray(read.landmarks.descriptor)
        assert descriptor.shape == (len(read.landmarks), read.info.dimension)
        if read.modes is not None:
            assert (read.modes.landmark >= 0).all()
            assert (read.modes.landmark < len(read.landmarks)).all()


def seeds() -> list[bytes]:
    """Whole maps without and with modes, a map.toml as text, and tables that are too much."""
    head = b"\1" + blocks(INFO)
    big = b"\1" + blocks(INFO.replace(b"dimension = 4", b"dimension = 0x" + b"f" * 20))
    endless = b"\1" + blocks(INFO.replace(b"dimension = 4", b"dimension = inf"))
    short = b"\0\7" + b"\xff" * 8 + b"{}"
    modes = b"\4\0"
    long = stretch((1, b"\1\xff\xff"), (30_000, b"a."))
    return [b"\0\0", modes, head, big, endless, short, long]
